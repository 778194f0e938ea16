/* Adaptive steps: interpolant, step-size control, Newton's method, runs, and discontinuities. */
#include "model.h"

#include "check.h"
#include "adaptive.h"
#include "rows.c"
#include "runs.h"

enum { S = EOM_GAUSS_STAGES };

/* x^n */
static real power(real x, int n)
{
    real result = 1;

    for (int i = 0; i < n; i++)
        result *= x;
    return result;
}

/* The Legendre polynomial of degree n. */
static real legendre(int n, real x)
{
    real before = 0, value = 1;

    for (int i = 1; i <= n; i++) {
        const real next = ((real)(2*i - 1)*x*value - (real)(i - 1)*before)/(real)i;

        before = value;
        value = next;
    }
    return value;
}

/* --- polynomials and errors ------------------------------------------------------------------------ */

/* The interpolant reproduces accelerations that are polynomials of degree 7, within the step and beyond it. */
static void test_interpolant(void)
{
    for (int degree = 0; degree < S; degree++) {
        const real q[NQ] = { 1, 2 }, qd[NQ] = { 3, 4 }, h = 2;
        eom_run_state s;
        eom_gauss_stages a, b;
        real q1[NQ], qd1[NQ], exact;

        memset(&s, 0, sizeof s);
        for (int i = 0; i < S; i++) {
            a.x[0][i] = power(eom_gauss_c[i], degree);
            a.x[1][i] = power(1 - eom_gauss_c[i], degree);
        }
        eom_store_interpolant(&s, &a);
        eom_predict_stages(&b, &s, 0, (real)0.7);
        for (int i = 0; i < S; i++) {
            exact = power((real)0.7*eom_gauss_c[i], degree);
            CHECK(eom_fabs(b.x[0][i] - exact) <= 64*EOM_EPS, b.x[0][i] - exact);
        }
        eom_predict_stages(&b, &s, 1, (real)0.5);
        for (int i = 0; i < S; i++) {
            exact = power(1 + eom_gauss_c[i]/2, degree);
            CHECK(eom_fabs(b.x[0][i] - exact) <= 16384*EOM_EPS, b.x[0][i] - exact);
        }
        eom_step_end(q1, qd1, &a, q, qd, h);
        exact = 3 + h/(real)(degree + 1);
        CHECK(eom_fabs(qd1[0] - exact) <= 16*EOM_EPS, qd1[0] - exact);
        exact = 1 + 3*h + h*h/(real)((degree + 1)*(degree + 2));
        CHECK(eom_fabs(q1[0] - exact) <= 64*EOM_EPS, q1[0] - exact);
        exact = 2 + 4*h + h*h/(real)(degree + 2);
        CHECK(eom_fabs(q1[1] - exact) <= 64*EOM_EPS, q1[1] - exact);
    }
}

/* The roughness of a step is the size of the last two Legendre coefficients of its accelerations. */
static void test_roughness(void)
{
    const real scale[NQ] = { 2, 1 }, coarse[NQ] = { 1, 1 };

    for (int n = 0; n < S; n++) {
        const real expected = n == 7 ? 2 : n == 6 ? (real)0.4 : 0;
        eom_gauss_stages a;
        real beyond, rough;

        for (int i = 0; i < S; i++) {
            a.x[0][i] = legendre(n, 2*eom_gauss_c[i] - 1);
            a.x[1][i] = 1;
        }
        rough = eom_roughness(&a, scale, coarse, (real)0.05, &beyond);
        CHECK(eom_fabs(rough - expected) <= 256*EOM_EPS, rough);
        CHECK(n > 5 ? beyond >= 1 - 256*EOM_EPS : beyond <= 256*EOM_EPS, beyond);
    }
}

/* --- step-size control ----------------------------------------------------------------------------- */

/* Make a step whose admissible size is `ideal`; returns the ratio of the next size to this one. */
static real control(eom_run_state *s, real ideal)
{
    eom_attempt a;

    memset(&a, 0, sizeof a);
    a.h = a.planned = s->h;
    a.factor = 1;
    a.x.sweeps = 3;
    eom_choose_next_size(s, &a, ideal, s->t + a.h/2);
    s->ideal = ideal;
    s->ideal_time = s->t + a.h/2;
    s->steps_since_restart += s->steps_since_restart < 2;
    s->t += a.h;
    return s->h/a.h;
}

/* The step size grows and shrinks at limited rates, and settles a little below the admissible size. */
static void test_step_size_control(void)
{
    eom_run_state s;
    real ratio;

    memset(&s, 0, sizeof s);
    s.h = (real)1e-3;
    for (int n = 0; n < 20; n++) {
        ratio = control(&s, 1);
        CHECK(ratio <= (n < 2 ? 4 : (real)1.7) + 8*EOM_EPS, ratio);
        CHECK(s.h <= 1, s.h);
    }
    CHECK(s.h > (real)0.9, s.h);
    for (int n = 0; n < 6; n++) {
        ratio = control(&s, (real)0.01);
        CHECK(ratio >= (real)0.2 - 8*EOM_EPS, ratio);
    }
    CHECK(s.h < (real)0.01 && s.h > (real)0.009, s.h);
}

/* A change of the admissible size that is linear in time is predicted. */
static void test_prediction_of_step_sizes(void)
{
    for (int sign = -1; sign <= 1; sign += 2) {
        eom_run_state s;

        memset(&s, 0, sizeof s);
        s.h = (real)0.1;
        for (int n = 0; n < 30; n++) {
            const real slope = (real)(0.1*sign), ideal = 1 + slope*(s.t + s.h/2);

            if (n > 6)
                CHECK(s.h > (real)0.94*ideal && s.h < (real)0.96*ideal, s.h/ideal);
            if (ideal < (real)0.1)
                break;
            (void)control(&s, ideal);
        }
    }
}

/* The error is of order eight in the step size. */
static void test_admissible_size(void)
{
    const real tol = (real)1e-6, aim = eom_sqrt(tol/2);
    eom_run_state s;
    eom_attempt a;

    memset(&s, 0, sizeof s);
    memset(&a, 0, sizeof a);
    a.outcome = EOM_NOT_CONVERGED;
    for (int n = 1; n < 8; n++) {
        a.x.rough = aim*power((real)n/2, 8);
        eom_assess_error(&a, &s, tol, aim);
        CHECK(eom_fabs(a.factor*(real)n/2 - 1) <= 16*EOM_EPS, a.factor);
    }
    a.x.rough = 0;
    eom_assess_error(&a, &s, tol, aim);
    CHECK(a.factor == 10, a.factor);
}

/* The first step is a fraction of the time scale of the motion, or of a short run. */
static void test_first_step_size(void)
{
    const real a[NQ] = { -4, 1 }, rate = eom_sqrt(4/(real)1.01); /* of the oscillation; 1.01: a coordinate and a part of the largest */
    eom_run_state s;

    memset(&s, 0, sizeof s);
    s.q[0] = 1;
    s.q[1] = -1;
    eom_initial_step_size(&s, a, (real)1e6);
    CHECK(eom_fabs(s.h*rate - (real)0.05) <= 4*EOM_EPS, s.h);
    CHECK(eom_fabs(s.span*rate - (real)1e4) <= 1e4*4*EOM_EPS, s.span);
    eom_initial_step_size(&s, a, 2);
    CHECK(eom_fabs(s.h - (real)0.002) <= EOM_EPS, s.h);
    CHECK(s.span == 2, s.span);
    s.q[0] = s.q[1] = EOM_EPS*EOM_EPS; /* zero within rounding: no scale */
    s.qd[0] = 1;
    s.t = 1;
    eom_initial_step_size(&s, a, 2);
    CHECK(s.h > 16*eom_least_step_size(&s), s.h);
}

/* Errors are relative to the motion in the step, and to a part of that of the fastest coordinate. */
static void test_error_scales(void)
{
    const real q[NQ] = { 20, 0 }, qd[NQ] = { 0, 3 }, h = 2;
    const real floor = EOM_SCALE_FLOOR, coarse_floor = EOM_COARSE_FLOOR;
    eom_gauss_stages a;
    real scale[NQ], coarse[NQ];

    for (int i = 0; i < S; i++) {
        a.x[0][i] = 1; /* velocities up to 2 + 2 */
        a.x[1][i] = 0;
    }
    eom_error_scales(scale, coarse, &a, q, qd, h, 0);
    CHECK(eom_fabs(scale[0] - 4/(2*4*(1 + floor))) <= 4*EOM_EPS, scale[0]);
    CHECK(eom_fabs(scale[1] - 4/(2*(3 + 4*floor))) <= 4*EOM_EPS, scale[1]);
    CHECK(eom_fabs(coarse[1] - 4/(2*(3 + 4*coarse_floor))) <= 4*EOM_EPS, coarse[1]);
    eom_error_scales(scale, coarse, &a, q, qd, h, (real)0.5); /* a velocity at least half its position */
    CHECK(eom_fabs(scale[0] - 4/((real)0.5*24*(1 + floor))) <= 4*EOM_EPS, scale[0]);
}

/* Steps that convergence limits, not the error, lead to Newton's method. */
static void test_stiffness(void)
{
    eom_run_state s;
    eom_attempt a;
    eom_output output;

    memset(&s, 0, sizeof s);
    memset(&a, 0, sizeof a);
    memset(&output, 0, sizeof output);
    a.h = 1;
    a.x.sweeps = 8;
    for (int n = 0; n < 4; n++) {
        CHECK(s.newton_steps == 0, n);
        eom_update_stiffness(&s, &a, 4, &output);
    }
    CHECK(s.newton_steps > 0, s.newton_steps);
    a.x.newton = 1;
    eom_update_stiffness(&s, &a, 4, &output);
    CHECK(s.used_newton && output.stiff_steps == 1, (double)output.stiff_steps);
    CHECK(s.newton_steps == EOM_NEWTON_STEPS - 1, s.newton_steps);
    a.x.newton = 0;
    a.x.sweeps = 3;
    for (int n = EOM_MAX_VOTES; n >= 0; n--) {
        CHECK(s.stiff_votes == n, s.stiff_votes);
        eom_update_stiffness(&s, &a, 1, &output);
    }
    CHECK(s.stiff_votes == 0, s.stiff_votes);
}

/* --- Newton's method ------------------------------------------------------------------------------- */

static void sweep(eom_gauss_stages *b, const eom_gauss_stages *a, const real *q, const real *qd, real h, const eom_model *m)
{
#if EOM_CONSTRAINTS
    CHECK(eom_gauss_sweep(b, a, q, qd, 0, h, 0, m), h);
#else
    CHECK(eom_gauss_sweep(b, a, q, qd, 0, h, m), h);
#endif
}

/* In a linear system, one correction of any accelerations solves the equations of the stages. */
static void test_newton_correction(void)
{
    const eom_model m = { .kind = STIFF_PAIR, .k = (real)1e4, .c = 100 };
    const real q[NQ] = { 1, (real)1.5 }, qd[NQ] = { 2, -1 }, h = (real)0.1;
    eom_output output;
    eom_solution x;
    eom_gauss_stages b, c;
    real before = 0, after = 0;

    memset(&output, 0, sizeof output);
    memset(&x, 0, sizeof x);
    eom_begin_newton(&x, q, qd, 0, h, &m, &output);
    CHECK(x.newton, x.newton);
    CHECK(output.evaluations == 2*NQ + 1, (double)output.evaluations);
    eom_factor_newton(&x.newton_data, h);
    sweep(&b, &x.a, q, qd, h, &m);
    for (int i = 0; i < S; i++)
        before = eom_fmax(before, eom_fabs(b.x[1][i] - x.a.x[1][i]));
    eom_newton_correction(&b, &x.a, &x.newton_data);
    sweep(&c, &b, q, qd, h, &m);
    for (int i = 0; i < S; i++)
        after = eom_fmax(after, eom_fabs(c.x[1][i] - b.x[1][i]));
    CHECK(before > 100 && after <= 100*EOM_SQRT_EPS*before, after/before);
}

/* --- runs ------------------------------------------------------------------------------------------ */

/* The error of a run is about its tolerance; a smaller tolerance needs more steps. */
static void test_accuracy(void)
{
    const eom_model m = { .kind = OSCILLATOR, .k = 1 };
    long last = 0;

    for (int digits = 4; digits <= 12; digits += 4) {
        const real tol = (real)pow(10, -digits);
        run r;

        start(&r, 1, 0, 0, 1);
        CHECK(integrate(&r, 20, tol, &m) == EOM_OK, digits);
        CHECK(r.output.t == 20, r.output.t);
        CHECK(eom_fabs(r.q[0] - (real)cos(20)) <= 20*tol, r.q[0] - cos(20));
        CHECK(eom_fabs(r.q[1] - (real)sin(20)) <= 20*tol, r.q[1] - sin(20));
        CHECK(r.output.steps > last, (double)r.output.steps);
        last = r.output.steps;
    }
#if EOM_KINKS
    CHECK(last < 100, (double)last);
#else
    CHECK(last < 40, (double)last);
#endif
}

/* Rows at given times are as accurate as steps; a run continues where its last call ended. */
static void test_rows_at_given_times(void)
{
    const eom_model m = { .kind = OSCILLATOR, .k = 1 };
    real times[40], q[40*NQ], qd[40*NQ];
    run r;

    start(&r, 1, 0, 0, 1);
    for (int n = 0; n < 40; n++)
        times[n] = (real)(n + 1)/4;
    r.options.times = times;
    r.options.rows = 40;
    r.output.q_rows = q;
    r.output.qd_rows = qd;
    for (int part = 1; part < 3; part++) {
        CHECK(integrate(&r, (real)(5*part), (real)1e-10, &m) == EOM_OK, part);
        CHECK(r.output.rows == 20*part, (double)r.output.rows);
    }
    for (int n = 0; n < 40; n++) {
        CHECK(eom_fabs(q[NQ*n] - (real)cos(times[n])) <= (real)1e-9, n);
        CHECK(eom_fabs(qd[NQ*n + 1] - (real)cos(times[n])) <= (real)1e-9, n);
    }
}

/* Rows at given times lie after the steps before them, or at steps within rounding; others after every n-th step. */
static void test_steps_of_rows(void)
{
    const real times[] = { 0, (real)0.25, (real)0.3, 1 };
    const long steps[] = { 0, 2, 3, 10 };
    eom_options options = { .h = (real)0.1, .every = 5, .rows = 4 };
    real since;

    CHECK(eom_row_step(&since, &options, 3, 20) == 15 && since == 0, since);
    CHECK(eom_row_step(&since, &options, 4, 20) > 20 && since == 0, since);
    options.times = times;
    for (long row = 0; row < 4; row++) {
        CHECK(eom_row_step(&since, &options, row, 20) == steps[row], (double)row);
        CHECK(eom_fabs(since - (row == 1 ? (real)0.05 : 0)) <= 4*EOM_EPS, since);
    }
    CHECK(eom_row_step(&since, &options, 3, 5) > 5, since);

    options.t0 = (real)1e5; /* the rounding errors of times are 1e-9 of a step */
    for (long n = 0; n < 100; n++) {
        const real time = options.t0 + (real)n*options.h;

        options.times = &time;
        CHECK(eom_row_step(&since, &options, 0, 200) == n && since == 0, since);
    }
}

#if !EOM_KINKS
/* Stiff motion is detected; Newton's method then needs few steps. */
static void test_stiff_run(void)
{
    const eom_model m = { .kind = STIFF_PAIR, .k = (real)1e10, .c = (real)1e5 };
    run r;

    start(&r, 1, 1, 0, 0);
    CHECK(integrate(&r, 10, (real)1e-8, &m) == EOM_OK, r.output.t);
    CHECK(eom_fabs(r.q[0] - (real)cos(10)) <= (real)1e-7, r.q[0] - cos(10));
    CHECK(eom_fabs(r.q[1] - r.q[0]) <= (real)1e-7, r.q[1] - r.q[0]);
    CHECK(r.output.stiff_steps > 0, (double)r.output.stiff_steps);
    CHECK(r.output.steps < 1000, (double)r.output.steps);
}
#endif

/* A run that can't continue returns why, with the last valid state. */
static void test_failing_runs(void)
{
    const eom_model lost = { .kind = PENDULUM, .reach = EOM_EPS }, m = { .kind = OSCILLATOR, .k = 1 };
    run r;

    start(&r, 2, 0, 0, 1);
    CHECK(integrate(&r, 1, (real)1e-8, &lost) == EOM_SINGULAR, r.output.t);
    CHECK(r.output.t == 0 && r.q[0] == 2, r.output.t);
    start(&r, 1, 0, 0, 1);
    r.options.max_evaluations = 100;
    CHECK(integrate(&r, 1000, (real)1e-8, &m) == EOM_TOO_LONG, r.output.t);
    CHECK(r.output.t > 0 && r.output.t < 1000, r.output.t);
    CHECK(eom_fabs(r.q[0] - (real)cos(r.output.t)) <= (real)1e-6, r.q[0] - cos(r.output.t));
}

#if EOM_CONSTRAINTS
/* All states of a run lie on the constraint, and its energy is constant. */
static void test_constrained_run(void)
{
    const eom_model m = { .kind = PENDULUM };
    run r;

    start(&r, 1, 0, 0, (real)0.5);
    for (int n = 1; n <= 10; n++) {
        CHECK(integrate(&r, (real)(2*n), (real)1e-9, &m) == EOM_OK, n);
        CHECK(eom_fabs(r.q[0]*r.q[0] + r.q[1]*r.q[1] - 1) <= 8*EOM_EPS, n);
        CHECK(eom_fabs(r.q[0]*r.qd[0] + r.q[1]*r.qd[1]) <= 16*EOM_EPS, n);
        CHECK(eom_fabs((r.qd[0]*r.qd[0] + r.qd[1]*r.qd[1])/2 + r.q[1] - (real)0.125) <= (real)1e-7, n);
    }
}
#endif

#if EOM_KINKS
/* The amplitude of a block with dry friction decreases by twice the friction in each half period. */
static void test_kinks(void)
{
    const eom_model m = { .kind = FRICTION, .c = (real)0.05 };
    run r;

    start(&r, 1, (real)0.8, 0, 0);
    for (int n = 1; n <= 6; n++) {
        const real sign = n % 2 ? -1 : 1, lost = (real)(0.1*n);

        CHECK(integrate(&r, (real)n*PI, (real)1e-9, &m) == EOM_OK, n);
        CHECK(eom_fabs(r.q[0] - sign*(1 - lost)) <= (real)1e-6, r.q[0]);
        CHECK(eom_fabs(r.q[1] - sign*((real)0.8 - lost)) <= (real)1e-6, r.q[1]);
    }
}
#endif

int main(void)
{
    test_interpolant();
    test_roughness();
    test_step_size_control();
    test_prediction_of_step_sizes();
    test_admissible_size();
    test_first_step_size();
    test_error_scales();
    test_stiffness();
    test_newton_correction();
    test_accuracy();
    test_rows_at_given_times();
    test_steps_of_rows();
    test_failing_runs();
#if !EOM_KINKS
    test_stiff_run();
#endif
#if EOM_CONSTRAINTS
    test_constrained_run();
#endif
#if EOM_KINKS
    test_kinks();
#endif
    return failures;
}
