/*
 * Steps of given size by Gauss methods of any number of stages. Fixed-point iteration or Newton's method solves
 * for the accelerations at the stages (Hairer & Wanner, Solving ODEs II, sec. IV.8).
 */

#if EOM_NEWTON
/* Attempts to solve for the stages, in this order. The last one is fixed-point iteration again. */
enum {
    EOM_FIXED_POINT,
    EOM_NEWTON_AT_START,
    EOM_NEWTON_AT_MIDDLE,
    EOM_NEWTON_FROM_ZERO,
    EOM_LAST_ATTEMPT
};

#endif
/* Whether the stages of a step have been found, may be found by iterating, or are not. */
typedef enum {
    EOM_ITERATION_CONVERGED,
    EOM_ITERATION_CONTINUES,
    EOM_ITERATION_FAILED
} eom_iteration_state;

/* Iteration over the stages of one step. */
typedef struct {
    real a[EOM_GAUSS_STAGES*EOM_NQ]; /* accelerations at the stages, (stages, nq) */
    real correction, noise; /* sizes of the last correction, see eom_gauss_measure */
    real rate; /* contraction rate: ratio of the last two corrections */
    int repetitions; /* number of iterations in this attempt after the first one */
    int finite; /* whether the accelerations exist and are finite */
    long evaluations; /* number of evaluations of the accelerations */
#if EOM_PROJECTED_STAGES
    int project; /* whether the stages are projected onto the constraints */
#endif
#if EOM_NEWTON
    int attempt;
    int newton; /* whether this attempt uses Newton's method */
    real halved; /* the first correction of this attempt, halved in each iteration */
    real q_mid[EOM_NQ], qd_mid[EOM_NQ]; /* state at the middle stage */
    real M[EOM_GAUSS_STAGES*EOM_NQ*EOM_GAUSS_STAGES*EOM_NQ]; /* factors of the matrix of Newton's method */
    int row[EOM_GAUSS_STAGES*EOM_NQ];
#endif
} eom_gauss_iteration;

/* r, v = the state at stage i of a step with the accelerations a at its stages. */
static void eom_gauss_stage(real *r, real *v, int i, const real *a, const real *q, const real *qd, real h)
{
    enum { S = EOM_GAUSS_STAGES, NQ = EOM_NQ };

    for (int k = 0; k < NQ; k++) {
        real of_q = 0, of_qd = 0;

        for (int j = 0; j < S; j++) {
            of_q += eom_gauss_AA[i][j]*a[NQ*j + k];
            of_qd += eom_gauss_A[i][j]*a[NQ*j + k];
        }
        r[k] = q[k] + h*(eom_gauss_c[i]*qd[k] + h*of_q);
        v[k] = qd[k] + h*of_qd;
    }
}

/* f = the accelerations at the stages to which the accelerations s->a lead. */
static eom_status eom_gauss_evaluate(real *f, eom_gauss_iteration *s, const real *q, const real *qd, real t, real h, const eom_model *m)
{
    enum { S = EOM_GAUSS_STAGES, NQ = EOM_NQ };
    eom_status result = EOM_OK;

    for (int i = 0; i < S; i++) {
        real r[NQ], v[NQ];
        eom_status status;

        eom_gauss_stage(r, v, i, s->a, q, qd, h);
#if EOM_NEWTON
        for (int k = 0; i == S/2 && k < NQ; k++) {
            s->q_mid[k] = r[k];
            s->qd_mid[k] = v[k];
        }
#endif
#if EOM_PROJECTED_STAGES
        if (s->project && eom_project_stage(r, v, t + eom_gauss_c[i]*h, m))
            status = EOM_SINGULAR;
        else
            status = eom_accelerate(f + NQ*i, r, v, t + eom_gauss_c[i]*h, m);
#else
        status = eom_accelerate(f + NQ*i, r, v, t + eom_gauss_c[i]*h, m);
#endif
        if (status)
            result = status;
    }
    s->evaluations += S;
    return result;
}

/*
 * Measure the corrections d of the accelerations. s->correction: the largest correction of a velocity, h d,
 * relative to the velocity. s->noise: the same, relative to the velocity and q/h, whose rounding errors cannot be
 * corrected.
 */
static void eom_gauss_measure(eom_gauss_iteration *s, const real *d, const real *q, const real *qd, real h)
{
    enum { NQ = EOM_NQ, N = EOM_GAUSS_STAGES*EOM_NQ };
    static const real RANGE = 1000000; /* of velocities: smaller ones have no digits of their own */
    real fastest = 0;

    for (int i = 0; i < N; i++)
        fastest = eom_fmax(fastest, eom_fabs(qd[i % NQ]) + eom_fabs(h*s->a[i]));
    s->correction = s->noise = 0;
    for (int k = 0; k < NQ; k++) {
        real gain = 0, change = 0, size;

        for (int i = k; i < N; i += NQ) {
            gain = eom_fmax(gain, eom_fabs(h*s->a[i]));
            change = eom_fmax(change, eom_fabs(h*d[i]));
        }
        size = eom_fmax(eom_fabs(qd[k]) + gain, fastest/RANGE) + EOM_TINY;
        s->correction = eom_fmax(s->correction, change/size);
        s->noise = eom_fmax(s->noise, change/(size + eom_fabs(q[k]/h)));
    }
}

/* Begin an attempt with the accelerations at the start of the step in all stages. */
static eom_status eom_gauss_start(eom_gauss_iteration *s, const real *q, const real *qd, real t, const eom_model *m)
{
    const eom_status status = eom_accelerate(s->a, q, qd, t, m);

    for (int i = EOM_NQ; i < EOM_GAUSS_STAGES*EOM_NQ; i++)
        s->a[i] = s->a[i - EOM_NQ];
    s->correction = 0;
    s->repetitions = -1;
    return status;
}

#if EOM_NEWTON
/* s->M = the factors of I - h A x da/dqd - h^2 A A x da/dq with the derivatives at q, qd. */
static eom_status eom_gauss_factor(eom_gauss_iteration *s, const real *q, const real *qd, real t, real h, const eom_model *m)
{
    enum { S = EOM_GAUSS_STAGES, NQ = EOM_NQ, N = S*NQ };
    real derivatives[2*NQ*NQ];
    const eom_status status = eom_differentiate(derivatives, q, qd, t, m);

    if (status)
        return status;
    for (int i = 0; i < S; i++)
        for (int k = 0; k < NQ; k++)
            for (int j = 0; j < S; j++)
                for (int l = 0; l < NQ; l++) {
                    const real of_q = eom_gauss_AA[i][j]*derivatives[2*NQ*k + l];
                    const real of_qd = eom_gauss_A[i][j]*derivatives[2*NQ*k + NQ + l];

                    s->M[N*(NQ*i + k) + NQ*j + l] = (real)(i == j && k == l) - h*(of_qd + h*of_q);
                }
    eom_factor(s->M, s->row, N);
    return EOM_OK;
}

/*
 * Begin the next attempt. Derivatives at the start of the step may be wrong for its stages: if Newton's method
 * contracts with them, it continues with derivatives at the middle, otherwise it starts again from zero.
 */
static eom_status eom_gauss_retry(eom_gauss_iteration *s, const real *q, const real *qd, real t, real h, const eom_model *m)
{
    const int small = s->noise*s->noise <= EOM_EPS;
    const int contracts = s->finite && (s->rate < 1 || small);
    eom_status status = EOM_OK;

    s->attempt++;
    s->newton = s->attempt != EOM_LAST_ATTEMPT;
    s->repetitions = -1;
    if (s->attempt == EOM_NEWTON_AT_MIDDLE && contracts)
        return eom_gauss_factor(s, s->q_mid, s->qd_mid, t + h/2, h, m);
    if (s->newton)
        status = eom_gauss_factor(s, q, qd, t, h, m);
    if (status)
        return status;
    if (s->attempt == EOM_NEWTON_AT_START || !s->newton)
        return eom_gauss_start(s, q, qd, t, m);
    for (int i = 0; i < EOM_GAUSS_STAGES*EOM_NQ; i++)
        s->a[i] = 0;
    return EOM_OK;
}

#endif
/* Correct the accelerations at the stages once. */
static eom_status eom_gauss_iterate(eom_gauss_iteration *s, const real *q, const real *qd, real t, real h, const eom_model *m)
{
    enum { N = EOM_GAUSS_STAGES*EOM_NQ };
    const real previous = s->correction;
    real d[N] = { 0 };
    const eom_status status = eom_gauss_evaluate(d, s, q, qd, t, h, m);

    for (int i = 0; i < N; i++)
        d[i] -= s->a[i];
#if EOM_NEWTON
    if (status == EOM_OK && s->newton)
        eom_substitute(s->M, s->row, d, N);
#endif
    for (int i = 0; i < N; i++)
        s->a[i] += d[i];
    s->finite = status == EOM_OK && eom_finite(s->a, N);
    eom_gauss_measure(s, d, q, qd, h);
    s->repetitions++;
    s->rate = s->repetitions > 0 ? s->correction/previous : 1;
#if EOM_NEWTON
    s->halved = s->repetitions > 0 ? s->halved/2 : s->correction;
#endif
    return status;
}

/*
 * Decide what follows an iteration. It has converged if the remaining error, estimated from the contraction rate,
 * is below an eighth of a rounding unit, or if the corrections are rounding errors, which do not contract.
 */
#if EOM_NEWTON
static eom_iteration_state eom_gauss_judge(const eom_gauss_iteration *s)
{
    enum { MAX_REPETITIONS = 50 };
    enum { FREE_REPETITIONS = 6 }; /* in which the last attempts need not contract */
    static const real FAST = (real)0.1; /* contraction rate that needs no new derivatives */
    static const real SLOW = (real)0.5; /* contraction rate of rounding errors, at least */
    static const real NOISE = 16; /* rounding units: smaller corrections need not contract */
    static const real NEWTON_NOISE = 4096; /* the same, since Newton's matrix amplifies rounding */
    const int small = s->noise*s->noise <= EOM_EPS;
    const int again = s->attempt > EOM_NEWTON_AT_START;
    const int last = s->attempt > EOM_NEWTON_AT_MIDDLE;
    real noise = NOISE;

    if (!s->finite)
        return EOM_ITERATION_FAILED;
    if (s->correction == 0 || (s->rate < 1 && s->correction*s->rate <= EOM_EPS/8*(1 - s->rate)))
        return EOM_ITERATION_CONVERGED;
    if (s->attempt != EOM_FIXED_POINT && s->rate >= SLOW)
        noise = NEWTON_NOISE;
    if (s->repetitions > 0 && s->rate >= FAST && s->noise <= noise*EOM_EPS)
        return EOM_ITERATION_CONVERGED;
    if (s->repetitions < MAX_REPETITIONS) {
        if (s->repetitions == 0 || s->rate < FAST || (again && s->rate < 1))
            return EOM_ITERATION_CONTINUES;
        if (last && (s->repetitions < FREE_REPETITIONS || s->correction < s->halved || small))
            return EOM_ITERATION_CONTINUES;
    }
    if (again && small)
        return EOM_ITERATION_CONVERGED;
    return EOM_ITERATION_FAILED;
}
#else
static eom_iteration_state eom_gauss_judge(const eom_gauss_iteration *s)
{
    enum { MAX_REPETITIONS = 60 };
    static const real SLOW = (real)0.5; /* contraction rate of rounding errors, at least */
    static const real NOISE = 16; /* rounding units: smaller corrections need not contract */
    const int small = s->noise*s->noise <= EOM_EPS;
#if EOM_PROJECTED_STAGES
    const int accurate = s->noise <= NOISE*EOM_EPS || (s->project && small);
#else
    const int accurate = s->noise <= NOISE*EOM_EPS;
#endif

    if (!s->finite)
        return EOM_ITERATION_FAILED;
    if (s->correction == 0 || (s->rate < 1 && s->correction*s->rate <= EOM_EPS/8*(1 - s->rate)))
        return EOM_ITERATION_CONVERGED;
    if ((s->rate >= SLOW && accurate) || (2*s->repetitions > MAX_REPETITIONS && small))
        return EOM_ITERATION_CONVERGED;
    if (s->repetitions < MAX_REPETITIONS)
        return EOM_ITERATION_CONTINUES;
    return EOM_ITERATION_FAILED;
}
#endif

/* s->a = the accelerations at the stages of a step from q, qd. */
static eom_status eom_gauss_solve(eom_gauss_iteration *s, const real *q, const real *qd, real t, real h, const eom_model *m)
{
    eom_status status = eom_gauss_start(s, q, qd, t, m);

    if (status)
        return status;
    s->evaluations++;
    for (;;) {
        eom_iteration_state state;

        status = eom_gauss_iterate(s, q, qd, t, h, m);
        state = eom_gauss_judge(s);
        if (state == EOM_ITERATION_CONVERGED)
            return EOM_OK;
        if (state == EOM_ITERATION_CONTINUES)
            continue;
#if EOM_NEWTON
        if (s->attempt != EOM_LAST_ATTEMPT) {
            status = eom_gauss_retry(s, q, qd, t, h, m);
            if (status)
                return status;
            continue;
        }
#endif
#if EOM_PROJECTED_STAGES
        if (!s->project) {
            s->project = 1;
            status = eom_gauss_start(s, q, qd, t, m);
            if (status)
                return status;
            continue;
        }
#endif
        if (status == EOM_SINGULAR)
            return status;
        return EOM_NO_CONVERGENCE;
    }
}

/* Advance q, qd by one step of size h. If the status is not OK, they are unchanged. */
#if EOM_CONSTRAINTS
static eom_status eom_gauss_advance(real *q, real *qd, real t, real h, const eom_model *m, long *evaluations, int *singular)
#else
static eom_status eom_gauss_advance(real *q, real *qd, real t, real h, const eom_model *m, long *evaluations)
#endif
{
    eom_gauss_iteration s;
    real r[EOM_NQ], v[EOM_NQ];
    eom_status status;

    s.evaluations = 0;
#if EOM_NEWTON
    s.attempt = EOM_FIXED_POINT;
    s.newton = 0;
#endif
#if EOM_PROJECTED_STAGES
    s.project = 0;
#endif
    status = eom_gauss_solve(&s, q, qd, t, h, m);
    *evaluations += s.evaluations;
    if (status)
        return status;
    eom_method_end_state(r, v, s.a, q, qd, h);
#if EOM_CONSTRAINTS
    status = eom_project_end(r, v, q, t + h, m, singular);
    if (status)
        return status;
#endif
    return eom_store_state(q, qd, r, v);
}
