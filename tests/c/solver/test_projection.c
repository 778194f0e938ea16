/*
 * Projection of states and of steps onto the unit circle in the metric D = diag(1, 4). With EOM_MULTIPLE, a second
 * equation is twice the first. With EOM_WEIGHTS, the second coordinate has no inertia.
 */
#define OWN_PROJECTION
#ifndef EOM_MULTIPLE
#define EOM_MULTIPLE 0
#endif
#include "model.h"

#include "check.h"

enum { EOM_NC = 1 + EOM_MULTIPLE, EOM_HOLONOMIC_ROWS = EOM_NC };
enum { EOM_CORRECTION_SIZE = 2*EOM_NQ + 1 };

#if EOM_WEIGHTS
static const real eom_row_weights[EOM_NC] = { 2 };
#endif
#if EOM_SUMS

static const real eom_row_sums[EOM_SUMS][EOM_NC] = { { 1, (real)0.5 } };
static const int eom_sum_rows[EOM_SUMS] = { 0 };
#endif
#if EOM_REDUNDANT
static const int eom_redundant_rows[EOM_NC] = { 0, 1 };
#endif

static void eom_evaluate_metric(real *D, const real *q, real t, const eom_model *m)
{
    (void)q;
    (void)t;
    (void)m;
    D[0] = 1;
    D[1] = D[2] = 0;
#if EOM_WEIGHTS
    D[3] = 0;
#else
    D[3] = 4;
#endif
}

static void eom_evaluate_jacobian(real *A, const real *q, real t, const eom_model *m)
{
    (void)t;
    (void)m;
    for (int r = 0; r < EOM_NC; r++)
        for (int i = 0; i < EOM_NQ; i++)
            A[EOM_NQ*r + i] = (real)(r + 1)*q[i];
}

static void eom_evaluate_residuals(real *residual, const real *q, const real *qd, real t, const eom_model *m)
{
    (void)qd;
    (void)t;
    (void)m;
    for (int r = 0; r < EOM_NC; r++)
        residual[r] = (real)(r + 1)*(q[0]*q[0] + q[1]*q[1] - 1)/2;
}

static void eom_evaluate_rates(real *residual, const real *q, const real *qd, real t, const eom_model *m)
{
    (void)t;
    (void)m;
    for (int r = 0; r < EOM_NC; r++)
        residual[r] = (real)(r + 1)*(q[0]*qd[0] + q[1]*qd[1]);
}

/* Corrections of q and qd, and the inverse pivot of the equation; it is 0 at the center of the circle. */
static int eom_evaluate_correction(real *d, const real *q, const real *qd, real t, const eom_model *m)
{
    const real pivot = q[0]*q[0] + q[1]*q[1]/4, inverse = pivot > EOM_EPS ? 1/pivot : 0;
    const real position = inverse*(q[0]*q[0] + q[1]*q[1] - 1)/2;
    real velocity;

    (void)t;
    (void)m;
    d[0] = -position*q[0];
    d[1] = -position*q[1]/4;
    velocity = inverse*((q[0] + d[0])*qd[0] + (q[1] + d[1])*qd[1]); /* of the rate after the change of q */
    d[2] = -velocity*q[0];
    d[3] = -velocity*q[1]/4;
    d[4] = inverse;
    return !(pivot - pivot == 0);
}

/* The rate of the equation, with k as its derivative by time, and the sum of the sizes of its terms. */
static void eom_evaluate_rate_terms(real *rates, const real *q, const real *qd, real t, const eom_model *m)
{
    (void)t;
    rates[0] = q[0]*qd[0] + q[1]*qd[1] - m->k;
    rates[1] = eom_fabs(q[0]*qd[0]) + eom_fabs(q[1]*qd[1]) + eom_fabs(m->k);
}

#include "projection.c"
#include "step_projection.c"

/* Whether a state satisfies the constraint to rounding. */
static int is_on_circle(const real *q, const real *qd)
{
    const real scale = 1 + eom_fabs(qd[0]) + eom_fabs(qd[1]);

    return eom_fabs(q[0]*q[0] + q[1]*q[1] - 1) < 64*EOM_EPS && eom_fabs(q[0]*qd[0] + q[1]*qd[1]) < 64*EOM_EPS*scale;
}

#if EOM_WEIGHTS
/* Only the coordinate without inertia changes, and only its velocity. */
static void test_coordinate_without_inertia(void)
{
    const eom_model m = { .kind = PENDULUM };
    real q[2] = { (real)0.6, (real)0.7 }, qd[2] = { 4, 5 };

    CHECK(eom_project_state(q, qd, 0, NULL, &m) == EOM_OK, q[0]);
    CHECK(eom_fabs(q[0] - (real)0.6) < 64*EOM_EPS && eom_fabs(q[1] - (real)0.8) < 64*EOM_EPS, q[1]);
    CHECK(eom_fabs(qd[0] - 4) < 64*EOM_EPS && eom_fabs(qd[1] + 3) < 64*EOM_EPS, qd[1]);
}

#else
/* A state on the circle is returned unchanged; others move by the least change: D d is parallel to the gradient. */
static void test_least_change(void)
{
    const eom_model m = { .kind = PENDULUM };
    const real tolerance = (real)1e-6 + 64*EOM_EPS; /* of the distance: the search ends at a relative change of 1e-7 */

    for (int n = 0; n < 200; n++) {
        const real distance = n % 2 ? (real)0.1 : (real)0.003, angle = 3*(real)draw();
        const real x[2] = { COS(angle) + distance*(real)draw(), SIN(angle) + distance*(real)draw() };
        const real xd[2] = { (real)draw(), (real)draw() };
        real q[2] = { x[0], x[1] }, qd[2] = { xd[0], xd[1] }, again[2], again_d[2];

        CHECK(eom_project_state(q, qd, 0, NULL, &m) == EOM_OK, n);
        CHECK(is_on_circle(q, qd), n);
        CHECK(eom_fabs((q[0] - x[0])*q[1] - 4*(q[1] - x[1])*q[0]) < tolerance, n);
        CHECK(eom_fabs((qd[0] - xd[0])*q[1] - 4*(qd[1] - xd[1])*q[0]) < 64*EOM_EPS, n);
        for (int i = 0; i < 2; i++) {
            again[i] = q[i];
            again_d[i] = qd[i];
        }
        CHECK(eom_project_state(again, again_d, 0, NULL, &m) == EOM_OK, n);
        CHECK(again[0] == q[0] && again[1] == q[1] && again_d[0] == qd[0] && again_d[1] == qd[1], n);
    }
}

#endif
/* Fixed entries do not change. If they contradict the constraint, the state is unchanged. */
static void test_fixed_entries(void)
{
    static const int x_fixed[4] = { 1, 0, 0, 0 }, rate_fixed[4] = { 0, 0, 1, 0 };
    const eom_model m = { .kind = PENDULUM };
    real q[2] = { (real)0.6, (real)0.7 }, qd[2] = { 1, 2 };

    CHECK(eom_project_state(q, qd, 0, x_fixed, &m) == EOM_OK, q[0]);
    CHECK(q[0] == (real)0.6 && eom_fabs(q[1] - (real)0.8) < 8*EOM_EPS, q[1]);
    CHECK(is_on_circle(q, qd), qd[0]);
    qd[0] = 1;
    CHECK(eom_project_state(q, qd, 0, rate_fixed, &m) == EOM_OK, qd[0]);
    CHECK(qd[0] == 1 && eom_fabs(qd[1] + (real)0.75) < 64*EOM_EPS, qd[1]);
    q[0] = 2;
    q[1] = (real)0.1;
    CHECK(eom_project_state(q, qd, 0, x_fixed, &m) != EOM_OK, q[0]);
    CHECK(q[0] == 2 && q[1] == (real)0.1 && qd[0] == 1, q[1]);
}

static void test_undefined_states(void)
{
    const eom_model m = { .kind = PENDULUM };
    real q[2] = { 1, (real)NAN }, qd[2] = { 0, 1 };

    CHECK(eom_project_state(q, qd, 0, NULL, &m) == EOM_NOT_FINITE, q[0]);
    CHECK(q[0] == 1 && qd[1] == 1, q[0]);
}

#if EOM_SEARCH
/* At the center of the circle, the gradient vanishes; a random position around it has a gradient. */
static void test_search(void)
{
    const eom_model m = { .kind = PENDULUM };
    real q[2] = { 0, 0 }, qd[2] = { 0, 1 };

    CHECK(eom_project_state(q, qd, 0, NULL, &m) == EOM_OK, q[0]);
    CHECK(is_on_circle(q, qd), q[1]);
}

#endif
/* Project the state r, v after a step from q. */
static eom_status project_end(real *r, real *v, const real *q, const eom_model *m, int *singular)
{
#if EOM_INCREMENTS
    const real qd[2] = { (real)0.5, (real)-0.25 };
    real step[2], step_d[2];
    eom_status status;

    for (int i = 0; i < 2; i++) {
        step[i] = r[i] - q[i];
        step_d[i] = v[i] - qd[i];
    }
    status = eom_project_end(step, step_d, q, qd, 0, m, singular);
    for (int i = 0; i < 2 && status == EOM_OK; i++) {
        r[i] = q[i] + step[i];
        v[i] = qd[i] + step_d[i];
    }
    return status;
#else
    return eom_project_end(r, v, q, 0, m, singular);
#endif
}

/* The end of a step is projected to rounding; a stage to first order. */
static void test_steps(void)
{
    const eom_model m = { .kind = PENDULUM };

    for (int n = 0; n < 100; n++) {
        const real angle = 3*(real)draw(), error = (real)0.01*(real)draw();
        const real q[2] = { COS(angle), SIN(angle) };
        real r[2] = { (1 + error)*q[0], (1 + error)*q[1] }, v[2] = { (real)draw(), (real)draw() }, left;
        real stage[2] = { r[0], r[1] }, stage_d[2] = { v[0], v[1] };
        int singular = 1;

        CHECK(project_end(r, v, q, &m, &singular) == EOM_OK, n);
        CHECK(is_on_circle(r, v) && !singular, n);
        CHECK(eom_project_stage(stage, stage_d, 0, &m) == 0, n);
        left = stage[0]*stage[0] + stage[1]*stage[1] - 1;
        CHECK(eom_fabs(left) <= 4*error*error + 8*EOM_EPS, left);
    }
}

/*
 * At the center of the circle, the equation has no pivot: the position is singular. The step fails if the rate of the
 * equation cannot be zero.
 */
static void test_singular_positions(void)
{
    const eom_model still = { .kind = PENDULUM }, moving = { .kind = PENDULUM, .k = 1 };
    const real q[2] = { 0, 0 };
    real r[2] = { 0, 0 }, v[2] = { 0, 1 }, undefined[2] = { 0, (real)INFINITY };
    int singular = 0;

    CHECK(project_end(r, v, q, &still, &singular) == EOM_OK, singular);
    CHECK(singular && r[0] == 0 && r[1] == 0 && v[1] == 1, singular);
    CHECK(project_end(r, v, q, &moving, &singular) == EOM_LOCKED, singular);
    CHECK(project_end(undefined, v, q, &still, &singular) == EOM_SINGULAR, singular);
    CHECK(eom_project_stage(undefined, v, 0, &still) == 1, singular);
}

int main(void)
{
#if EOM_WEIGHTS
    test_coordinate_without_inertia();
#else
    test_least_change();
#endif
    test_fixed_entries();
    test_undefined_states();
#if EOM_SEARCH
    test_search();
#endif
    test_steps();
    test_singular_positions();
    return failures;
}
