/*
 * Models for tests of csrc/solver: what a scene's C source defines in front of the library, written by hand.
 * Before it is included, macros select the features of the library, and SINGLE single precision.
 */
#ifndef MODEL_H
#define MODEL_H

#include <float.h>
#include <limits.h>
#include <math.h>
#include <stdio.h>
#include <string.h>

#ifdef SINGLE
typedef float real;
#define SIN sinf
#define COS cosf
#define TANH tanhf
#else
typedef double real;
#define SIN sin
#define COS cos
#define TANH tanh
#endif

#define EOM_LANES

enum { EOM_NQ = 2, EOM_WIDTH = EOM_NQ, EOM_NE = 3 };

/* Constants, coefficients and tables, as emitted for a scene: written by the test in Python. */
#include "tables.h"

typedef enum {
    EOM_OK,
    EOM_SINGULAR,
    EOM_NOT_FINITE,
    EOM_NO_CONVERGENCE,
    EOM_LOCKED,
    EOM_ACCUMULATED,
    EOM_TOO_LONG
} eom_status;

typedef enum {
    OSCILLATOR, /* q'' = -k q - c q': two harmonic oscillators; k = 1e8: stiff */
    COUPLED, /* two pendulums with a spring between them, a damper, and a force of time */
    POLYNOMIAL, /* q'' = (degree + 1) t^degree */
    STIFF_PAIR, /* q'' = -q, and an oscillator that a stiff spring and damper hold at it */
    STEEP_FRICTION, /* a block on a spring with dry friction, smoothed over velocities of about 1/k */
    FRICTION, /* two blocks on springs with dry friction c */
    BALL, /* a ball in free fall, and an oscillator: q'' = -q */
    PENDULUM /* a point mass (x, y) on the unit circle, with gravity along -y */
} model_kind;

typedef struct {
    model_kind kind;
    real k, c;
    int degree;
    real reach; /* the pendulum's distance from its circle beyond which it has no accelerations */
    long *evaluations;
    real restitution; /* of the ball's impacts at q[0] = 0 */
    real (*mark)(real q); /* event function of q[0]; NULL: that of the oscillator, q[1] */
    real stop; /* time at which a run stops; 0: none */
    const real *u; /* of the coupled pendulums: an additional acceleration of the first; NULL: none */
} eom_model;

typedef struct {
    real t0, t_end, h, tol, max_step;
    int stiff;
    long steps, every, max_evaluations, rows;
    const real *times;
} eom_options;

typedef struct {
    int warm;
    real data[256];
} eom_workspace;

/* The results of a run. */
typedef struct {
    real *q_rows, *qd_rows, *t_rows;
    long rows, steps, evaluations, rejected, stiff_steps, singular;
    real first;
    int has_started;
    real t;
    int stopped, *which;
    long room, events;
    real limit, *event_rows;
    eom_workspace *memory;
} eom_output;

static eom_status eom_accelerate(real *qdd, const real *q, const real *qd, real t, const eom_model *m)
{
    if (m->evaluations)
        ++*m->evaluations;
    switch (m->kind) {
    case OSCILLATOR:
        for (int i = 0; i < EOM_NQ; i++)
            qdd[i] = -m->k*q[i] - m->c*qd[i];
        break;
    case COUPLED:
        qdd[0] = -SIN(q[0]) + (q[1] - q[0])/2 - m->c*qd[0]*COS(q[1]) + COS(2*t)/4 + (m->u ? *m->u : 0);
        qdd[1] = -2*SIN(q[1]) + (q[0] - q[1])/2 - m->c*(qd[1] - qd[0]);
        break;
    case POLYNOMIAL:
        qdd[0] = qdd[1] = (real)(m->degree + 1);
        for (int i = 0; i < m->degree; i++)
            qdd[0] = qdd[1] *= t;
        break;
    case STIFF_PAIR:
        qdd[0] = -q[0];
        qdd[1] = -m->k*(q[1] - q[0]) - m->c*(qd[1] - qd[0]);
        break;
    case STEEP_FRICTION:
        qdd[0] = -q[0] - TANH(m->k*qd[0]);
        qdd[1] = -4*q[1];
        break;
    case FRICTION:
        for (int i = 0; i < EOM_NQ; i++)
            qdd[i] = -q[i] - m->c*(real)((qd[i] > 0) - (qd[i] < 0));
        break;
    case BALL:
        qdd[0] = -10;
        qdd[1] = -q[1];
        break;
    case PENDULUM: {
        const real square = q[0]*q[0] + q[1]*q[1];
        const real along = (qd[0]*qd[0] + qd[1]*qd[1] - q[1])/square; /* -A^T lambda */

        if (m->reach > 0 && eom_fabs(square - 1) > m->reach)
            return EOM_SINGULAR;
        qdd[0] = -along*q[0];
        qdd[1] = -along*q[1] - 1;
        break;
    }
    }
    for (int i = 0; i < EOM_NQ; i++)
        if (!isfinite(qdd[i]))
            return EOM_NOT_FINITE;
    return EOM_OK;
}

#ifndef OWN_PROJECTION
/* Move the state r, v onto the constraint of the pendulum. Returns 0 on success. */
static inline int eom_project_stage(real *r, real *v, real t, const eom_model *m)
{
    const real length = eom_sqrt(r[0]*r[0] + r[1]*r[1]);
    real across;

    (void)t;
    if (m->kind != PENDULUM)
        return 0;
    r[0] /= length;
    r[1] /= length;
    across = r[0]*v[0] + r[1]*v[1];
    v[0] -= across*r[0];
    v[1] -= across*r[1];
    return !(length > 0);
}

/* Project the state r, v after a step from q onto the constraint. */
static inline eom_status eom_project_end(real *r, real *v, const real *q, real t, const eom_model *m, int *singular)
{
    (void)q;
    *singular = 0;
    return eom_project_stage(r, v, t, m) ? EOM_SINGULAR : EOM_OK;
}

/* Project a state onto the constraint. */
static inline eom_status eom_project_state(real *q, real *qd, real t, const int *fixed, const eom_model *m)
{
    (void)fixed;
    return eom_project_stage(q, qd, t, m) ? EOM_SINGULAR : EOM_OK;
}

#endif
/* The events: an impact, where the state jumps; a mark, which is recorded; the end, where the run stops. */
static inline void eom_event_functions(real *g, const real *q, const real *qd, real t, const eom_model *m)
{
    (void)qd;
    g[0] = m->kind == BALL ? q[0] : 1;
    g[1] = m->mark ? m->mark(q[0]) : q[1];
    g[2] = m->stop > 0 ? t - m->stop : -1;
}

/* after = the states after the jump of each event. */
static inline void eom_jump_maps(real *after, const real *q, const real *qd, real t, const eom_model *m)
{
    (void)t;
    for (int k = 0; k < EOM_NE; k++)
        for (int i = 0; i < EOM_NQ; i++) {
            after[2*EOM_NQ*k + i] = q[i];
            after[2*EOM_NQ*k + EOM_NQ + i] = qd[i];
        }
    after[EOM_NQ] = -m->restitution*qd[0];
}

/* A step without an error: of uniform motion, or of the ball and the oscillator beside it. */
static inline eom_status eom_call_step(real *q, real *qd, real t, real h, const eom_model *m)
{
    const real q1 = q[1], qd1 = qd[1];

    (void)t;
    if (m->kind != BALL) {
        for (int i = 0; i < EOM_NQ; i++)
            q[i] += h*qd[i];
        return EOM_OK;
    }
    q[0] += h*(qd[0] - 5*h);
    qd[0] -= 10*h;
    q[1] = q1*COS(h) + qd1*SIN(h);
    qd[1] = qd1*COS(h) - q1*SIN(h);
    return EOM_OK;
}

static inline int eom_finite(const real *x, int n)
{
    for (int i = 0; i < n; i++)
        if (!isfinite(x[i]))
            return 0;
    return 1;
}

#endif
