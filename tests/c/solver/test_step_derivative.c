/* Derivatives of a step, compared with differences of steps. The input u is the stiffness of the oscillators. */
#ifndef EOM_INPUTS
#define EOM_INPUTS 0
#endif
#include "model.h"

#include "check.h"

enum { EOM_NU = 1, EOM_VARIABLES = 2*EOM_NQ + EOM_INPUTS };

#ifdef EOM_GAUSS_STAGES
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

#if EOM_INPUTS
static eom_status eom_evaluate_linearization(real *A_q, real *A_qd, real *B, const real *q, const real *qd, real t, const eom_model *m)
#else
static eom_status eom_evaluate_linearization(real *A_q, real *A_qd, const real *q, const real *qd, real t, const eom_model *m)
#endif
{
    const real square = q[0]*q[0] + q[1]*q[1], along = (qd[0]*qd[0] + qd[1]*qd[1] - q[1])/square;

    (void)t;
    for (int i = 0; i < EOM_NQ; i++) {
#if EOM_INPUTS
        B[i] = -q[i];
#endif
        for (int j = 0; j < EOM_NQ; j++) {
            A_q[EOM_NQ*i + j] = i == j ? -m->k : 0;
            A_qd[EOM_NQ*i + j] = i == j ? -m->c : 0;
            if (m->kind == PENDULUM) {
                A_q[EOM_NQ*i + j] = q[i]*((real)(j == 1) + 2*along*q[j])/square - (i == j ? along : 0);
                A_qd[EOM_NQ*i + j] = -2*q[i]*qd[j]/square;
            }
        }
    }
    if (m->kind == COUPLED) {
        A_q[0] = -COS(q[0]) - (real)0.5;
        A_q[1] = (real)0.5 + m->c*qd[0]*SIN(q[1]);
        A_q[2] = (real)0.5;
        A_q[3] = -2*COS(q[1]) - (real)0.5;
        A_qd[0] = -m->c*COS(q[1]);
        A_qd[1] = 0;
        A_qd[2] = m->c;
        A_qd[3] = -m->c;
    }
    return EOM_OK;
}

/* The corrections of r and v onto the constraint of the pendulum, and their derivatives along a direction. */
static inline int eom_evaluate_correction_along(real *column, const real *along, const real *r, const real *v, real t, const eom_model *m)
{
    const real square = r[0]*r[0] + r[1]*r[1], square_d = 2*(r[0]*along[0] + r[1]*along[1]);
    const real position = (square - 1)/(2*square), position_d = square_d/(2*square*square);
    const real velocity = (r[0]*v[0] + r[1]*v[1])/square;
    const real velocity_d = (along[0]*v[0] + along[1]*v[1] + r[0]*along[2] + r[1]*along[3] - velocity*square_d)/square;

    (void)t;
    for (int i = 0; i < EOM_NQ; i++) {
        column[i] = -position*r[i];
        column[2 + i] = -velocity*r[i];
        column[4 + i] = -position_d*r[i] - position*along[i];
        column[6 + i] = -velocity_d*r[i] - velocity*along[i];
    }
    if (m->kind != PENDULUM)
        for (int i = 0; i < 8; i++)
            column[i] = 0;
    return !(square > 0);
}

#include "state.c"
#include "step_end.c"
#ifdef EOM_GAUSS_STAGES
#include "linear.c"
#include "differences.c"
#include "gauss_fixed.c"
#else
#include "explicit.c"
#endif
#include "step_derivative.c"

static eom_status advance(real *q, real *qd, real t, real h, const eom_model *m)
{
#if EOM_CONSTRAINTS
    int singular;
#endif
#ifdef EOM_GAUSS_STAGES
    long evaluations = 0;

#if EOM_CONSTRAINTS
    return eom_gauss_advance(q, qd, t, h, m, &evaluations, &singular);
#else
    return eom_gauss_advance(q, qd, t, h, m, &evaluations);
#endif
#else
#if EOM_CONSTRAINTS
    return eom_explicit_advance(q, qd, t, h, m, &singular);
#else
    return eom_explicit_advance(q, qd, t, h, m);
#endif
#endif
}

/* ends = the derivatives of a step. */
static eom_status differentiate(real *ends, const real *x, real t, real h, const eom_model *m)
{
    real end[4] = { x[0], x[1], x[2], x[3] };
    const eom_status status = advance(end, end + 2, t, h, m);

#ifdef EOM_GAUSS_STAGES
    return status ? status : eom_method_differentiate_implicit_step(ends, end, end + 2, x, x + 2, t, h, m);
#elif EOM_CONSTRAINTS
    return status ? status : eom_method_differentiate_explicit_step(ends, end, end + 2, x, x + 2, t, h, m);
#else
    return status ? status : eom_method_differentiate_explicit_step(ends, x, x + 2, t, h, m);
#endif
}

/* Compare the derivatives of a step from x with central differences. */
static void compare(const real *x, const eom_model *m)
{
    enum { W = EOM_VARIABLES };
#ifdef SINGLE
    const real by = (real)0.01, tolerance = (real)3e-3;
#else
    const real by = (real)1e-5, tolerance = (real)1e-8;
#endif
    const real t = (real)0.3, h = (real)0.2;
    real ends[2*EOM_NQ*W] = { 0 }, Phi[2*EOM_NQ*2*EOM_NQ] = { 0 };
#if EOM_INPUTS
    real Gamma[2*EOM_NQ] = { 0 };
#endif

    CHECK(differentiate(ends, x, t, h, m) == EOM_OK, x[0]);
    eom_copy_columns(Phi, ends, 0, 2*EOM_NQ);
#if EOM_INPUTS
    eom_copy_columns(Gamma, ends, 2*EOM_NQ, EOM_NU);
#endif
    for (int w = 0; w < W; w++) {
        real plus[4] = { x[0], x[1], x[2], x[3] }, minus[4] = { x[0], x[1], x[2], x[3] };
        eom_model more = *m, less = *m;

        if (w < 4) {
            plus[w] += by;
            minus[w] -= by;
        } else {
            more.k += by;
            less.k -= by;
        }
        CHECK(advance(plus, plus + 2, t, h, &more) == EOM_OK, w);
        CHECK(advance(minus, minus + 2, t, h, &less) == EOM_OK, w);
        for (int i = 0; i < 4; i++) {
            const real slope = (plus[i] - minus[i])/(2*by);

            CHECK(eom_fabs(ends[W*i + w] - slope) < tolerance, ends[W*i + w] - slope);
            if (w < 4)
                CHECK(Phi[4*i + w] == ends[W*i + w], w);
#if EOM_INPUTS
            else
                CHECK(Gamma[i] == ends[W*i + w], w);
#endif
        }
    }
}

/* A step that fails has no derivatives. */
static void test_failed_steps(void)
{
    const eom_model lost = { .kind = PENDULUM, .reach = (real)0.01 };
    const real x[4] = { 2, 0, 0, 1 };
    real ends[2*EOM_NQ*EOM_VARIABLES];

    CHECK(differentiate(ends, x, 0, (real)0.1, &lost) == EOM_SINGULAR, 0);
}

int main(void)
{
    const eom_model oscillator = { .kind = OSCILLATOR, .k = 2, .c = (real)0.5 }, coupled = { .kind = COUPLED, .c = (real)0.25 };
    const eom_model pendulum = { .kind = PENDULUM };

    for (int n = 0; n < 20; n++) {
        const real angle = 3*(real)draw(), rate = (real)draw();
        const real x[4] = { (real)draw(), (real)draw(), (real)draw(), (real)draw() };
        const real on_circle[4] = { COS(angle), SIN(angle), -rate*SIN(angle), rate*COS(angle) };

        compare(x, &oscillator);
        if (!EOM_INPUTS) {
            compare(x, &coupled);
            compare(on_circle, &pendulum);
        }
    }
    test_failed_steps();
    return failures;
}
