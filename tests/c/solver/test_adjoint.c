/*
 * The adjoint of runs, compared with differences of runs of two coupled pendulums. The input u is an acceleration of the
 * first, the parameter is the damping c.
 */
#ifndef EOM_INPUTS
#define EOM_INPUTS 0
#endif
#ifndef EOM_PARAMETERS
#define EOM_PARAMETERS 0
#endif
#define EOM_DRIVEN 1
#include "model.h"

#include "check.h"

enum { EOM_NU = 1, EOM_VARIABLES = 2*EOM_NQ + EOM_INPUTS + EOM_PARAMETERS };

#if EOM_IMPLICIT
#define eom_method_c eom_gauss_c
#define eom_method_A eom_gauss_A
#define eom_method_AA eom_gauss_AA
#define eom_method_b eom_gauss_b
#define eom_method_bA eom_gauss_bA
#else
#define eom_method_c eom_explicit_c
#define eom_method_A eom_explicit_A
#define eom_method_AA eom_explicit_AA
#define eom_method_b eom_explicit_b
#define eom_method_bA eom_explicit_bA
#endif

static eom_status eom_evaluate_acceleration_vjp(real *bar, const real *q, const real *qd, const real *qdd_bar, real t, const eom_model *m)
{
    const real first = qdd_bar[0], second = qdd_bar[1];

    (void)t;
    bar[0] = (real)0.5*second - (COS(q[0]) + (real)0.5)*first;
    bar[1] = ((real)0.5 + m->c*qd[0]*SIN(q[1]))*first - (2*COS(q[1]) + (real)0.5)*second;
    bar[2] = m->c*(second - COS(q[1])*first);
    bar[3] = -m->c*second;
    if (EOM_INPUTS)
        bar[4] = first;
    if (EOM_PARAMETERS)
        bar[EOM_VARIABLES - 1] = -qd[0]*COS(q[1])*first - (qd[1] - qd[0])*second;
    return m->reach > 0 && q[0]*q[0] > m->reach ? EOM_SINGULAR : EOM_OK;
}

#include "state.c"
#include "step_end.c"
#if EOM_IMPLICIT
#include "linear.c"
#include "differences.c"
#include "gauss_fixed.c"
#else
#include "explicit.c"
#endif
#include "adjoint.c"

enum { STEPS = 38, HOLD = 4, MAX_ROWS = STEPS + 1, INPUT_ROWS = (STEPS + HOLD - 1)/HOLD };

static const real T0 = (real)0.1, H = (real)0.05;
static real times[STEPS + 1]; /* at the starts of the steps, and at the end */
static real q_rows[EOM_NQ*MAX_ROWS], qd_rows[EOM_NQ*MAX_ROWS], q_bars[EOM_NQ*MAX_ROWS], qd_bars[EOM_NQ*MAX_ROWS];

static eom_status advance(real *q, real *qd, real t, real h, const eom_model *m)
{
#if EOM_IMPLICIT
    long evaluations = 0;

    return eom_gauss_advance(q, qd, t, h, m, &evaluations);
#else
    return eom_explicit_advance(q, qd, t, h, m);
#endif
}

/* The rows of a run from x with inputs u; returns the sum of their products with q_bars, qd_bars. */
static real run_steps(const real *x, const real *u, long every, real damping)
{
    eom_model m = { .kind = COUPLED, .c = damping };
    real q[2] = { x[0], x[1] }, qd[2] = { x[2], x[3] }, sum = 0;
    long row = 0;

    for (long n = 0; n <= STEPS; n++) {
        if (n % every == 0 || n == STEPS) {
            for (int i = 0; i < 2; i++) {
                q_rows[2*row + i] = q[i];
                qd_rows[2*row + i] = qd[i];
                sum += q[i]*q_bars[2*row + i] + qd[i]*qd_bars[2*row + i];
            }
            row++;
        }
        m.u = EOM_INPUTS ? u + n/HOLD : NULL;
        if (n < STEPS)
            CHECK(advance(q, qd, times[n], times[n + 1] - times[n], &m) == EOM_OK, n);
    }
    return sum;
}

/*
 * Compare the adjoint of a run with rows after each `every` steps with central differences. With a row after each step,
 * the steps have various sizes.
 */
static void compare(long every)
{
#ifdef SINGLE
    const real by = (real)0.01, tolerance = (real)2e-2;
#else
    const real by = (real)1e-4, tolerance = (real)1e-6;
#endif
    const eom_model m = { .kind = COUPLED, .c = (real)0.25 };
    real work[(EOM_METHOD_STAGES + 4)*(STEPS + 1)*EOM_NQ], gradient[4 + INPUT_ROWS + 1] = { 0 };
    real values[4 + INPUT_ROWS + 1], *const p_bar = gradient + 4 + INPUT_ROWS, t_bar[2] = { 0, 0 };
    eom_adjoint_run run = { .t0 = T0, .h = H, .steps = STEPS, .every = every };
    eom_adjoint_sums to = { .q = gradient, .qd = gradient + 2 };

    for (int n = 0; n <= STEPS; n++)
        times[n] = T0 + (real)n*H + (every == 1 ? (real)(n % 3)*H/8 : 0);
    if (every == 1) {
        run.times = times;
        to.t = t_bar;
    }
    for (int i = 0; i < 4 + INPUT_ROWS; i++)
        values[i] = (real)draw();
    values[4 + INPUT_ROWS] = m.c;
    for (int i = 0; i < EOM_NQ*MAX_ROWS; i++) {
        q_bars[i] = (real)draw();
        qd_bars[i] = (real)draw();
    }
#if EOM_INPUTS
    run.u = values + 4;
    run.hold = HOLD;
    to.u = gradient + 4;
#endif
#if EOM_PARAMETERS
    to.p = p_bar;
#endif
    (void)p_bar;
    run_steps(values, values + 4, every, m.c);
    CHECK(eom_method_pull_back_run(&to, q_rows, qd_rows, q_bars, qd_bars, &run, &m, work) == EOM_OK, every);
    for (int i = 0; i < 4 + INPUT_ROWS + 1; i++) {
        const real value = values[i];
        real slope;

        if ((i >= 4 && i < 4 + INPUT_ROWS && !EOM_INPUTS) || (i == 4 + INPUT_ROWS && !EOM_PARAMETERS))
            continue;
        values[i] = value + by;
        slope = run_steps(values, values + 4, every, values[4 + INPUT_ROWS]);
        values[i] = value - by;
        slope = (slope - run_steps(values, values + 4, every, values[4 + INPUT_ROWS]))/(2*by);
        values[i] = value;
        CHECK(eom_fabs(gradient[i] - slope) < tolerance*(1 + eom_fabs(slope)), gradient[i] - slope);
    }
    for (int i = 0; i < 2 && every == 1; i++) {
        real *const time = times + (i ? STEPS : 0), value = *time;
        real slope;

        *time = value + by;
        slope = run_steps(values, values + 4, every, m.c);
        *time = value - by;
        slope = (slope - run_steps(values, values + 4, every, m.c))/(2*by);
        *time = value;
        CHECK(eom_fabs(t_bar[i] - slope) < tolerance*(1 + eom_fabs(slope)), t_bar[i] - slope);
    }
}

/* A stage at which there are no derivatives ends the adjoint. */
static void test_failed_stages(void)
{
    const eom_model m = { .kind = COUPLED, .reach = (real)1e-6 };
    real work[(EOM_METHOD_STAGES + 4)*(STEPS + 1)*EOM_NQ], x[4] = { 1, 0, 0, 0 }, sums[4 + INPUT_ROWS + 1] = { 0 };
    eom_adjoint_run run = { .t0 = T0, .h = H, .steps = 1, .every = 1 };
    eom_adjoint_sums to = { .q = sums, .qd = sums + 2 };

#if EOM_INPUTS
    run.u = x + 3;
    run.hold = 1;
    to.u = sums + 4;
#endif
#if EOM_PARAMETERS
    to.p = sums + 4 + INPUT_ROWS;
#endif
    CHECK(eom_method_pull_back_run(&to, x, x + 2, q_bars, qd_bars, &run, &m, work) == EOM_SINGULAR, 0);
}

int main(void)
{
    for (long every = 1; every <= STEPS; every += 1 + every/2)
        compare(every);
    compare(STEPS);
    compare(1000);
    test_failed_stages();
    return failures;
}
