/* Steps of Gauss methods with fixed steps: with Newton's method, or with projection of the stages. */
#include "model.h"

#include "check.h"
#include "state.c"
#if EOM_NEWTON
#include "linear.c"
#include "differences.c"
#endif
#define eom_method_c eom_gauss_c
#define eom_method_A eom_gauss_A
#define eom_method_AA eom_gauss_AA
#define eom_method_b eom_gauss_b
#define eom_method_bA eom_gauss_bA
#include "step_end.c"
#include "gauss_fixed.c"

static long returned = 0; /* evaluations that the steps have returned */

static eom_status advance(real *q, real *qd, real t, real h, const eom_model *m)
{
#if EOM_CONSTRAINTS
    int singular;

    return eom_gauss_advance(q, qd, t, h, m, &returned, &singular);
#else
    return eom_gauss_advance(q, qd, t, h, m, &returned);
#endif
}

#include "steps.h"

enum { STAGES = EOM_GAUSS_STAGES };

static real difference(const real *a, const real *b, int n)
{
    real largest = 0;

    for (int i = 0; i < n; i++)
        largest = eom_fmax(largest, eom_fabs(a[i] - b[i]));
    return largest;
}

/* The accelerations at the stages satisfy the equations of the method. */
static void test_stages(real h, const eom_model *m)
{
    const real q[2] = { 1, (real)1.5 }, qd[2] = { 2, -1 };
    eom_gauss_iteration s;
    real a[2*STAGES], f[2*STAGES] = { 0 }, largest = 0;

    memset(&s, 0, sizeof s);
    CHECK(eom_gauss_solve(&s, q, qd, 0, h, m) == EOM_OK, h);
    memcpy(a, s.a, sizeof a);
    CHECK(eom_gauss_evaluate(f, &s, q, qd, 0, h, m) == EOM_OK, h);
    for (int i = 0; i < 2*STAGES; i++)
        largest = eom_fmax(largest, eom_fabs(a[i]));
    CHECK(difference(f, a, 2*STAGES) <= 1000*EOM_EPS*(largest + m->k*(2 + h*h*largest)), h);
}

static void test_stages_of_smooth_motion(void)
{
    const eom_model m = { .kind = COUPLED, .c = (real)0.5 };

    for (int n = 1; n <= 8; n *= 2)
        test_stages((real)0.1*(real)n, &m);
}

/* Gauss methods preserve quadratic invariants, such as the energy of an oscillator, for every step size. */
static void test_energy(void)
{
    const eom_model m = { .kind = OSCILLATOR, .k = 4 };
    real q[2] = { 1, -2 }, qd[2] = { 3, 4 };

    for (int n = 0; n < 100; n++)
        CHECK(advance(q, qd, 0, (real)0.5, &m) == EOM_OK, n);
    CHECK(eom_fabs(qd[0]*qd[0] + 4*q[0]*q[0] - 13) <= 500*13*EOM_EPS, qd[0]*qd[0] + 4*q[0]*q[0] - 13);
    CHECK(eom_fabs(qd[1]*qd[1] + 4*q[1]*q[1] - 32) <= 500*32*EOM_EPS, qd[1]*qd[1] + 4*q[1]*q[1] - 32);
}

/* Evaluations are counted; few are needed for a short step. */
static void test_evaluations(void)
{
    long counted = 0;
    const eom_model m = { .kind = OSCILLATOR, .k = 1, .evaluations = &counted };
    const real q[2] = { 1, 0 }, qd[2] = { 0, 1 };
    real q_end[2] = { 1, 0 }, qd_end[2] = { 0, 1 };
    eom_gauss_iteration s;

    returned = 100;
    memset(&s, 0, sizeof s);
    CHECK(eom_gauss_solve(&s, q, qd, 0, (real)0.001, &m) == EOM_OK, 0);
    CHECK(s.evaluations == counted, (double)counted);
    CHECK(counted <= 1 + 6*STAGES, (double)counted);
    counted = 0;
    CHECK(advance(q_end, qd_end, 0, (real)0.001, &m) == EOM_OK, 0);
    CHECK(returned == counted + 100, (double)returned);
}

/* Corrections are measured relative to the velocities, or to the velocities and q/h. */
static void test_measure(void)
{
    const real h = 2, q[2] = { 6, 8 }, qd[2] = { 3, -1 };
    eom_gauss_iteration s;
    real d[2*STAGES] = { 0 };

    memset(&s, 0, sizeof s);
    for (int i = 0; i < STAGES; i++)
        s.a[2*i + 1] = -2;
    d[2*STAGES - 2] = (real)0.3; /* of a velocity 3, with q/h = 3 */
    eom_gauss_measure(&s, d, q, qd, h);
    CHECK(eom_fabs(s.correction - (real)0.2) <= 4*EOM_EPS, s.correction);
    CHECK(eom_fabs(s.noise - (real)0.1) <= 4*EOM_EPS, s.noise);
    d[3] = 1; /* of a velocity 1 + 4, with q/h = 4 */
    eom_gauss_measure(&s, d, q, qd, h);
    CHECK(eom_fabs(s.correction - (real)0.4) <= 4*EOM_EPS, s.correction);
    CHECK(eom_fabs(s.noise - (real)2/9) <= 4*EOM_EPS, s.noise);
    s.a[1] = (real)1e8; /* beside which 3 has no digits of its own */
    d[3] = 0;
    eom_gauss_measure(&s, d, q, qd, h);
    CHECK(eom_fabs(s.correction - (real)0.6/200) <= (real)1e-8, s.correction);
}

/* What follows an iteration: another one, another attempt, or the end of the step. */
static void test_judgement(void)
{
    static const struct {
        int attempt, repetitions;
        real rate, correction, halved, noise; /* noise in rounding units */
        eom_iteration_state expected;
    } cases[] = {
        { 0, 5, (real)0.5, 0, 0, 0, EOM_ITERATION_CONVERGED },
        { 0, 5, (real)1e-9, (real)1e-9*EOM_EPS, 1, 1000, EOM_ITERATION_CONVERGED },
        { 0, 5, (real)0.5, EOM_EPS/9, 1, 1000, EOM_ITERATION_CONVERGED },
        { 0, 5, (real)0.7, EOM_EPS/4, 1, 15, EOM_ITERATION_CONVERGED },
        { 0, 0, 1, 1, 1, 1e6, EOM_ITERATION_CONTINUES },
        { 0, 5, (real)0.05, 1, 1, 1e6, EOM_ITERATION_CONTINUES },
#if EOM_NEWTON
        { 0, 5, (real)0.5, EOM_EPS/7, 1, 1e6, EOM_ITERATION_FAILED },
        { 0, 5, (real)0.2, 1, 1, 15, EOM_ITERATION_CONVERGED },
        { 0, 5, (real)0.2, 1, 1, 17, EOM_ITERATION_FAILED },
        { 0, 50, (real)0.05, 1, 1, 1e6, EOM_ITERATION_FAILED },
        { EOM_NEWTON_AT_START, 5, (real)0.6, 1, 1, 4000, EOM_ITERATION_CONVERGED },
        { EOM_NEWTON_AT_START, 5, (real)0.4, 1, 1, 4000, EOM_ITERATION_FAILED },
        { EOM_NEWTON_AT_START, 5, (real)0.6, 1, 1, 4200, EOM_ITERATION_FAILED },
        { EOM_NEWTON_AT_MIDDLE, 5, (real)0.9, 1, 0, 1e10, EOM_ITERATION_CONTINUES },
        { EOM_NEWTON_AT_MIDDLE, 5, (real)1.1, 1, 2, 1e10, EOM_ITERATION_FAILED },
        { EOM_NEWTON_FROM_ZERO, 5, (real)1.1, 1, 0, 1e10, EOM_ITERATION_CONTINUES },
        { EOM_NEWTON_FROM_ZERO, 6, (real)1.1, 1, 0, 1e10, EOM_ITERATION_FAILED },
        { EOM_NEWTON_FROM_ZERO, 6, (real)1.1, 1, 2, 1e10, EOM_ITERATION_CONTINUES },
        { EOM_NEWTON_FROM_ZERO, 50, (real)1.1, 1, 2, 1e10, EOM_ITERATION_FAILED },
#ifndef SINGLE /* in single precision, 4200 rounding units are no small noise */
        { EOM_NEWTON_AT_MIDDLE, 5, (real)1.1, 1, 0, 4200, EOM_ITERATION_CONVERGED },
        { EOM_LAST_ATTEMPT, 50, (real)1.1, 1, 2, 4200, EOM_ITERATION_CONVERGED },
#endif
#else
        { 0, 5, (real)0.5, EOM_EPS/7, 1, 1e6, EOM_ITERATION_CONTINUES },
        { 0, 5, (real)0.7, EOM_EPS, 1, 17, EOM_ITERATION_CONTINUES },
        { 0, 5, (real)0.4, EOM_EPS, 1, 15, EOM_ITERATION_CONTINUES },
        { 0, 30, (real)1.1, 1, 1, 1000, EOM_ITERATION_CONTINUES },
        { 0, 31, (real)1.1, 1, 1, 1000, EOM_ITERATION_CONVERGED },
        { 0, 59, (real)1.1, 1, 1, 1e10, EOM_ITERATION_CONTINUES },
        { 0, 60, (real)0.4, 1, 1, 1e10, EOM_ITERATION_FAILED },
#endif
#if EOM_PROJECTED_STAGES
        { 1, 5, (real)0.7, 1, 1, 1000, EOM_ITERATION_CONVERGED },
        { 1, 5, (real)0.4, 1, 1, 1000, EOM_ITERATION_CONTINUES },
#endif
    };

    for (int n = 0; n < (int)(sizeof cases/sizeof cases[0]); n++) {
        eom_gauss_iteration s;

        memset(&s, 0, sizeof s);
        CHECK(eom_gauss_judge(&s) == EOM_ITERATION_FAILED, n); /* not finite */
        s.finite = 1;
        s.repetitions = cases[n].repetitions;
        s.rate = cases[n].rate;
        s.correction = cases[n].correction;
        s.noise = cases[n].noise*EOM_EPS;
#if EOM_NEWTON
        s.attempt = cases[n].attempt;
        s.halved = cases[n].halved;
#endif
#if EOM_PROJECTED_STAGES
        s.project = cases[n].attempt;
#endif
        CHECK(eom_gauss_judge(&s) == cases[n].expected, n);
    }
}

#if EOM_NEWTON
/* Newton's method solves stiff steps with few iterations. */
static void test_stiff_pair(void)
{
    const eom_model m = { .kind = STIFF_PAIR, .k = (real)1e6, .c = (real)1e3 };
    const real q[2] = { 1, (real)1.5 }, qd[2] = { 2, -1 };
    eom_gauss_iteration s;

    memset(&s, 0, sizeof s);
    CHECK(eom_gauss_solve(&s, q, qd, 0, (real)0.1, &m) == EOM_OK, 0);
    CHECK(s.attempt == EOM_NEWTON_AT_START, s.attempt);
    CHECK(s.evaluations <= 60*STAGES, (double)s.evaluations);
    test_stages((real)0.1, &m);
}

/* The methods are A-stable: the motion of the stiff spring is damped for every step size. */
static void test_damping(void)
{
    const eom_model m = { .kind = STIFF_PAIR, .k = (real)1e6, .c = (real)1e3 };
    real q[2] = { 1, (real)1.1 }, qd[2] = { 0 };

    for (int n = 0; n < 200; n++)
        CHECK(advance(q, qd, 0, (real)0.01, &m) == EOM_OK, n);
    CHECK(eom_fabs(q[1] - q[0]) < (real)1e-3, q[1] - q[0]);
    CHECK(eom_fabs(q[0] - (real)cos(2)) < (real)1e-3, q[0]);
}

/* Where derivatives at the start are wrong for the stages, those at the middle are used. */
static void test_kink(void)
{
    const eom_model m = { .kind = STEEP_FRICTION, .k = 100 };
    int attempt = 0;

    for (int i = 0; i < 50; i++) {
        const real q[2] = { (real)0.1, 1 }, qd[2] = { (real)(0.002*i - 0.05), 0 };
        eom_gauss_iteration s;

        memset(&s, 0, sizeof s);
        CHECK(eom_gauss_solve(&s, q, qd, 0, (real)0.016, &m) == EOM_OK, qd[0]);
        attempt = s.attempt > attempt ? s.attempt : attempt;
    }
    CHECK(attempt >= EOM_NEWTON_AT_MIDDLE, attempt);
}
#else
/* Fixed-point iteration does not converge in steps that are long compared with the fastest motion. */
static void test_long_steps(void)
{
    const eom_model m = { .kind = OSCILLATOR, .k = (real)1e6 };
    real q[2] = { 1, 2 }, qd[2] = { 3, 4 };

    CHECK(advance(q, qd, 0, (real)0.1, &m) == EOM_NO_CONVERGENCE, 0);
    CHECK(q[0] == 1 && qd[1] == 4, q[0]);
}
#endif

#if EOM_CONSTRAINTS
/* The end of each step lies on the constraint; energy is preserved to the order of the method. */
static void test_pendulum(void)
{
    const eom_model m = { .kind = PENDULUM };
    real q[2] = { 1, 0 }, qd[2] = { 0, (real)0.5 };

    for (int n = 0; n < 100; n++) {
        CHECK(advance(q, qd, 0, (real)0.05, &m) == EOM_OK, n);
        CHECK(eom_fabs(q[0]*q[0] + q[1]*q[1] - 1) <= 8*EOM_EPS, q[0]*q[0] + q[1]*q[1] - 1);
        CHECK(eom_fabs(q[0]*qd[0] + q[1]*qd[1]) <= 8*EOM_EPS, q[0]*qd[0] + q[1]*qd[1]);
    }
    CHECK(eom_fabs((qd[0]*qd[0] + qd[1]*qd[1])/2 + q[1] - (real)0.125) < (real)1e-5, q[1]);
}
#endif

#if EOM_PROJECTED_STAGES
/* Where the stages have no accelerations off the constraint, they are projected onto it. */
static void test_projected_stages(void)
{
    const eom_model m = { .kind = PENDULUM, .reach = 4*EOM_EPS };
    const real q[2] = { 1, 0 }, qd[2] = { 0, 2 };
    eom_gauss_iteration s;

    memset(&s, 0, sizeof s);
    CHECK(eom_gauss_solve(&s, q, qd, 0, (real)0.5, &m) == EOM_OK, 0);
    CHECK(s.project, s.project);
}
#endif

int main(void)
{
    test_steps();
    test_stages_of_smooth_motion();
    test_energy();
    test_evaluations();
    test_measure();
    test_judgement();
#if EOM_NEWTON
    test_stiff_pair();
    test_damping();
    test_kink();
#else
    test_long_steps();
#endif
#if EOM_CONSTRAINTS
    test_pendulum();
#endif
#if EOM_PROJECTED_STAGES
    test_projected_stages();
#endif
    return failures;
}
