/*
 * The discrete adjoint of a run with fixed steps of a Runge-Kutta method: the derivatives of a function of
 * its rows with respect to its start, inputs and parameters, step by step backwards (Hager, Numer. Math. 87 (2000),
 * 247). The name x_bar stands for the derivative of that function with respect to x.
 */

/* A run with fixed steps, the n-th from t0 + n h, or with steps of any sizes, with row n/hold of the table u of inputs. */
typedef struct {
    real t0, h;
    long steps, every; /* there is a row after each `every` steps, and after the last step */
    const real *times; /* of the rows, one after each step of any size; NULL: all steps are of size h */
#if EOM_INPUTS
    const real *u; /* NULL: the scene's signals, at each stage */
    long hold;
#endif
} eom_adjoint_run;

/* Derivatives with respect to the present state, to the inputs of each row of the table, and to the parameters. */
typedef struct {
    real *q, *qd;
    real *t; /* those with respect to the times of the first and of the last row; NULL: they are not needed */
#if EOM_INPUTS
    real *u;
#endif
#if EOM_PARAMETERS
    real *p;
#endif
} eom_adjoint_sums;

/* The size of the n-th step. */
static real eom_adjoint_size(const eom_adjoint_run *run, long n)
{
    return run->times ? run->times[n + 1] - run->times[n] : run->h;
}

#if EOM_IMPLICIT
/* Whether an iteration has converged: a sweep changes values by rounding, relative to their size (sums of magnitudes). */
static int eom_sweeps_end(real change, real last, real size)
{
    static const real CONVERGED = 16*EOM_EPS, ROUNDING = 1000*EOM_EPS; /* relative */

    return change <= CONVERGED*size || (change >= last/2 && change <= ROUNDING*size);
}

/* a = the accelerations at the stages of the step from q, qd, by fixed-point iteration. */
static eom_status eom_method_find_stages(real *a, const real *q, const real *qd, real t, real h, const eom_model *m)
{
    enum { NQ = EOM_NQ, S = EOM_METHOD_STAGES, MAX_SWEEPS = 100 };
    real r[EOM_WIDTH], v[EOM_WIDTH], qdd[EOM_WIDTH] = { 0 }, last = 0;

    for (int i = 0; i < S*NQ; i++)
        a[i] = 0;
    for (int n = 0; n < MAX_SWEEPS; n++) {
        real change = 0, size = 0;

        for (int i = 0; i < S; i++) {
            eom_status status;

            eom_method_stage_state(r, v, a, i, S, q, qd, h);
            status = eom_accelerate(qdd, r, v, t + eom_method_c[i]*h, m);
            if (status)
                return n > 0 ? EOM_NO_CONVERGENCE : status;
            for (int k = 0; k < NQ; k++) {
                change += eom_fabs(qdd[k] - a[NQ*i + k]);
                size += eom_fabs(qdd[k]);
                a[NQ*i + k] = qdd[k];
            }
        }
        if (eom_sweeps_end(change, last, size))
            return EOM_OK;
        last = change;
    }
    return EOM_NO_CONVERGENCE;
}
#else
/* a = the accelerations at the stages of the step from q, qd. */
static eom_status eom_method_find_stages(real *a, const real *q, const real *qd, real t, real h, const eom_model *m)
{
    enum { NQ = EOM_NQ };
    real r[EOM_WIDTH], v[EOM_WIDTH], qdd[EOM_WIDTH] = { 0 };

    for (int i = 0; i < EOM_METHOD_STAGES; i++) {
        eom_status status;

        eom_method_stage_state(r, v, a, i, i, q, qd, h);
        status = eom_accelerate(qdd, r, v, t + eom_method_c[i]*h, m);
        if (status)
            return status;
        for (int k = 0; k < NQ; k++)
            a[NQ*i + k] = qdd[k];
    }
    return EOM_OK;
}
#endif

/*
 * Record n steps, from the state at the beginning of the first record on. A record has the start q, qd of a step and the
 * accelerations at its stages. The state after the steps follows the last record. first: number of the first step.
 */
static eom_status eom_method_record_steps(real *records, long first, long n, const eom_adjoint_run *run, const eom_model *m)
{
    enum { NQ = EOM_NQ, S = EOM_METHOD_STAGES, RECORD = (2 + S)*NQ };
#if EOM_INPUTS
    eom_model own = *m;
#endif

    for (long k = 0; k < n; k++) {
        real *const q = records + RECORD*k, *const qd = q + NQ, *const a = qd + NQ, *const next = a + S*NQ;
        const real h = eom_adjoint_size(run, first + k);
        eom_status status;

#if EOM_INPUTS
        own.u = run->u ? run->u + EOM_NU*((first + k)/run->hold) : run->u;
        m = &own;
#endif
        status = eom_method_find_stages(a, q, qd, run->times ? run->times[first + k] : run->t0 + (real)(first + k)*run->h, h, m);
        if (status)
            return status;
        eom_method_end_state(next, next + NQ, a, q, qd, h);
    }
    return EOM_OK;
}

/* bar = the derivatives by [q, qd, u, p] of the sum of the accelerations times qdd_bar. */
static eom_status eom_pull_back_accelerations(real *bar, const real *qdd_bar, const real *q, const real *qd, real t, const eom_model *m)
{
    const eom_status status = eom_evaluate_acceleration_vjp(bar, q, qd, qdd_bar, t, m);
#if EOM_FEEDBACK
    real of_signals[EOM_VARIABLES];

    if (status == EOM_OK && !m->u) {
        eom_evaluate_signal_vjp(of_signals, bar, q, qd, t, m);
        for (int k = 0; k < EOM_VARIABLES; k++)
            bar[k] += of_signals[k];
    }
#endif
    return status;
}

/*
 * bars = the derivatives by [q, qd, u, p] of the accelerations at each stage of a recorded step, times those of the end
 * by them: directly, a_bars, and through the other stages, from the last to the first. Returns the status.
 */
#if EOM_IMPLICIT
/* The others are those of the last sweep. change: that of bars by this sweep; size: their size, both sums of magnitudes. */
static eom_status eom_method_pull_back_stages(real *bars, const real *a_bars, const real *record, real t, real h, const eom_model *m, real *change, real *size)
#else
static eom_status eom_method_pull_back_stages(real *bars, const real *a_bars, const real *record, real t, real h, const eom_model *m)
#endif
{
    enum { NQ = EOM_NQ, S = EOM_METHOD_STAGES, W = EOM_VARIABLES };
    const real *const q = record, *const qd = q + NQ, *const a = qd + NQ;
    real a_bar[NQ], bar[W], r[NQ], v[NQ];

    for (int i = S - 1; i >= 0; i--) {
#if EOM_IMPLICIT
        const int count = S, first = 0;
#else
        const int count = i, first = i + 1;
#endif
        eom_status status;

        for (int k = 0; k < NQ; k++) {
            a_bar[k] = a_bars[NQ*i + k];
            for (int j = first; j < S; j++)
                a_bar[k] += h*(h*eom_method_AA[j][i]*bars[W*j + k] + eom_method_A[j][i]*bars[W*j + NQ + k]);
        }
        eom_method_stage_state(r, v, a, i, count, q, qd, h);
        status = eom_pull_back_accelerations(bar, a_bar, r, v, t + eom_method_c[i]*h, m);
        if (status)
            return status;
#if EOM_IMPLICIT
        for (int k = 0; k < 2*NQ; k++) {
            *change += eom_fabs(bar[k] - bars[W*i + k]);
            *size += eom_fabs(bar[k]);
        }
#endif
        for (int k = 0; k < W; k++)
            bars[W*i + k] = bar[k];
    }
    return EOM_OK;
}

#if EOM_IMPLICIT
/* bars = the same for all stages of an implicit method, by fixed-point iteration. */
static eom_status eom_method_pull_back_all_stages(real *bars, const real *a_bars, const real *record, real t, real h, const eom_model *m)
{
    enum { MAX_SWEEPS = 100 };
    real last = 0;

    for (int i = 0; i < EOM_METHOD_STAGES*(EOM_VARIABLES); i++)
        bars[i] = 0;
    for (int n = 0; n < MAX_SWEEPS; n++) {
        real change = 0, size = 0;
        const eom_status status = eom_method_pull_back_stages(bars, a_bars, record, t, h, m, &change, &size);

        if (status)
            return n > 0 ? EOM_NO_CONVERGENCE : status;
        if (eom_sweeps_end(change, last, size))
            return EOM_OK;
        last = change;
    }
    return EOM_NO_CONVERGENCE;
}

#endif
#if EOM_DRIVEN
/*
 * The derivative of the accelerations times qdd_bar with respect to the time t, by differences of fourth order in parts
 * of the step size h, times h: as small as they are, their errors are rounding errors of the accelerations.
 */
static eom_status eom_pull_back_time(real *by_time, const real *qdd_bar, const real *q, const real *qd, real t, real h, const eom_model *m)
{
    static const real PARTS = 64, OFFSETS[4] = { -2, -1, 1, 2 }, WEIGHTS[4] = { 1, -8, 8, -1 };

    *by_time = 0;
    for (int n = 0; n < 4; n++) {
        real qdd[EOM_WIDTH] = { 0 };
        const eom_status status = eom_accelerate(qdd, q, qd, t + OFFSETS[n]*h/PARTS, m);

        if (status)
            return status;
        for (int k = 0; k < EOM_NQ; k++)
            *by_time += PARTS*WEIGHTS[n]/12*qdd_bar[k]*qdd[k];
    }
    return EOM_OK;
}

#endif
/*
 * t_bar += the derivatives with respect to the times t of the start and t + h of the end of a recorded step. q_bar, qd_bar: those
 * with respect to its end. bars: as above.
 */
static eom_status eom_method_pull_back_times(real *t_bar, const real *q_bar, const real *qd_bar, const real *bars, const real *record, real t, real h, const eom_model *m)
{
    enum { NQ = EOM_NQ, S = EOM_METHOD_STAGES, W = EOM_VARIABLES };
    const real *const qd = record + NQ, *const a = qd + NQ;
    real by_size = 0, by_start = 0;

    for (int i = 0; i < S; i++) {
        const real *const A = eom_method_A[i], *const AA = eom_method_AA[i], *const bar = bars + W*i;
#if EOM_DRIVEN
        real qdd_bar[NQ], r[NQ], v[NQ], by_time; /* by the accelerations, divided by h; the state at the stage */
        eom_status status;
#endif

        for (int k = 0; k < NQ; k++) {
            const real end_bar = 2*h*eom_method_bA[i]*q_bar[k] + eom_method_b[i]*qd_bar[k];
            real r_rate = eom_method_c[i]*qd[k], v_rate = 0; /* of the state at the stage, by h */

            for (int j = 0; j < S; j++) {
                r_rate += 2*h*AA[j]*a[NQ*j + k];
                v_rate += A[j]*a[NQ*j + k];
            }
            by_size += end_bar*a[NQ*i + k] + bar[k]*r_rate + bar[NQ + k]*v_rate;
        }
#if EOM_DRIVEN
        for (int k = 0; k < NQ; k++) {
            qdd_bar[k] = h*eom_method_bA[i]*q_bar[k] + eom_method_b[i]*qd_bar[k];
            for (int j = 0; j < S; j++)
                qdd_bar[k] += h*eom_method_AA[j][i]*bars[W*j + k] + eom_method_A[j][i]*bars[W*j + NQ + k];
        }
        eom_method_stage_state(r, v, a, i, S, record, qd, h);
        status = eom_pull_back_time(&by_time, qdd_bar, r, v, t + eom_method_c[i]*h, h, m);
        if (status)
            return status;
        by_size += eom_method_c[i]*by_time;
        by_start += by_time;
#endif
    }
    for (int k = 0; k < NQ; k++)
        by_size += q_bar[k]*qd[k];
    t_bar[0] += by_start - by_size;
    t_bar[1] += by_size;
#if !EOM_DRIVEN
    (void)t;
    (void)m;
#endif
    return EOM_OK;
}

/*
 * Replace the derivatives with respect to the end of a recorded step by those with respect to its start. t_bar: as
 * above; NULL: those with respect to the times are not needed.
 */
static eom_status eom_method_pull_back_step(const eom_adjoint_sums *to, const real *record, real t, real h, const eom_model *m, real *t_bar)
{
    enum { NQ = EOM_NQ, S = EOM_METHOD_STAGES, W = EOM_VARIABLES };
    real a_bars[S*NQ], bars[S*(W)];
    eom_status status;

    for (int k = 0; k < NQ; k++)
        for (int i = 0; i < S; i++)
            a_bars[NQ*i + k] = h*(h*eom_method_bA[i]*to->q[k] + eom_method_b[i]*to->qd[k]);
#if EOM_IMPLICIT
    status = eom_method_pull_back_all_stages(bars, a_bars, record, t, h, m);
#else
    status = eom_method_pull_back_stages(bars, a_bars, record, t, h, m);
#endif
    if (status == EOM_OK && t_bar)
        status = eom_method_pull_back_times(t_bar, to->q, to->qd, bars, record, t, h, m);
    for (int k = 0; k < NQ; k++)
        to->qd[k] += h*to->q[k];
    for (int i = 0; i < S && status == EOM_OK; i++) {
        const real *const bar = bars + W*i;

        for (int k = 0; k < NQ; k++) {
            to->q[k] += bar[k];
            to->qd[k] += bar[NQ + k] + h*eom_method_c[i]*bar[k];
        }
#if EOM_INPUTS
        for (int k = 0; k < EOM_NU; k++)
            to->u[k] += bar[2*NQ + k];
#endif
#if EOM_PARAMETERS
        for (int k = 0; k < EOM_PARAMETERS; k++)
            to->p[k] += bar[W - EOM_PARAMETERS + k];
#endif
    }
    return status;
}

/* Replace the derivatives with respect to the end of n recorded steps by those with respect to their start. */
static eom_status eom_method_pull_back_steps(const eom_adjoint_sums *to, const real *records, long first, long n, const eom_adjoint_run *run, const eom_model *m)
{
    enum { RECORD = (2 + EOM_METHOD_STAGES)*EOM_NQ };
    eom_adjoint_sums sums = *to;
#if EOM_INPUTS
    eom_model own = *m;
#endif

    for (long k = n - 1; k >= 0; k--) {
        const real h = eom_adjoint_size(run, first + k);
        const int starts = first + k == 0, ends = first + k == run->steps - 1;
        real t_bar[2] = { 0, 0 };
        eom_status status;
#if EOM_INPUTS
        const long row = (first + k)/run->hold;

        own.u = run->u ? run->u + EOM_NU*row : run->u;
        m = &own;
        sums.u = to->u + EOM_NU*row;
#endif
        status = eom_method_pull_back_step(&sums, records + RECORD*k, run->times ? run->times[first + k] : run->t0 + (real)(first + k)*run->h, h, m, to->t && (starts || ends) ? t_bar : 0);
        if (status)
            return status;
        if (to->t) {
            to->t[0] += starts ? t_bar[0] : 0;
            to->t[1] += ends ? t_bar[1] : 0;
        }
    }
    return EOM_OK;
}

/*
 * The same for n steps from the state q, qd, which are made again. They are made in parts of about sqrt(n) steps: first
 * all parts, to store the state at the beginning of each, then each part once more, from the last to the first, to
 * record its steps (checkpointing; Griewank & Walther, Evaluating Derivatives, 2nd ed., ch. 12).
 */
static eom_status eom_method_pull_back_interval(const eom_adjoint_sums *to, const real *q, const real *qd, long first, long n, const eom_adjoint_run *run, const eom_model *m, real *work)
{
    enum { NQ = EOM_NQ, RECORD = (2 + EOM_METHOD_STAGES)*NQ };
    eom_status status = EOM_OK;
    long size = 1, parts;
    real *records;

    while (size*size < n)
        size++;
    parts = (n + size - 1)/size;
    records = work + 2*NQ*parts;
    eom_copy_state(records, records + NQ, q, qd);
    for (long k = 0; k < parts && status == EOM_OK; k++) {
        const long count = k < parts - 1 ? size : n - size*k;
        const real *const end = records + RECORD*count;

        eom_copy_state(work + 2*NQ*k, work + 2*NQ*k + NQ, records, records + NQ);
        status = eom_method_record_steps(records, first + size*k, count, run, m);
        if (k < parts - 1)
            eom_copy_state(records, records + NQ, end, end + NQ);
    }
    for (long k = parts - 1; k >= 0 && status == EOM_OK; k--) {
        const long count = k < parts - 1 ? size : n - size*k;

        if (k < parts - 1) {
            eom_copy_state(records, records + NQ, work + 2*NQ*k, work + 2*NQ*k + NQ);
            status = eom_method_record_steps(records, first + size*k, count, run, m);
        }
        if (status == EOM_OK)
            status = eom_method_pull_back_steps(to, records, first + size*k, count, run, m);
    }
    return status;
}

/*
 * Add the derivatives of a function of the rows of a run to `to`, where those with respect to the state are zero before.
 * q_bars, qd_bars: its derivatives with respect to the rows q_rows, qd_rows. work: see the header of the model.
 */
static eom_status eom_method_pull_back_run(const eom_adjoint_sums *to, const real *q_rows, const real *qd_rows, const real *q_bars, const real *qd_bars, const eom_adjoint_run *run, const eom_model *m, real *work)
{
    enum { NQ = EOM_NQ };
    long n = run->steps;

    for (long row = (n + run->every - 1)/run->every; row >= 0; row--) {
        for (int k = 0; k < NQ; k++) {
            to->q[k] += q_bars[NQ*row + k];
            to->qd[k] += qd_bars[NQ*row + k];
        }
        if (row > 0) {
            const long first = run->every*(row - 1);
            const eom_status status = eom_method_pull_back_interval(to, q_rows + NQ*(row - 1), qd_rows + NQ*(row - 1), first, n - first, run, m, work);

            if (status)
                return status;
            n = first;
        }
    }
    if (!eom_finite(to->q, NQ) || !eom_finite(to->qd, NQ))
        return EOM_NOT_FINITE;
    return EOM_OK;
}
