/* Projection of the end of a step, and of its stages, onto the constraints. */

/* A correction of a state, compared with the state: sums of squares. */
typedef struct {
    real position, velocity; /* of q and q' before the correction */
    real position_change, velocity_change; /* of the corrections of both */
    int is_large; /* whether a coordinate changes by more than rounding errors of second order allow */
} eom_correction_size;

#if EOM_INCREMENTS
/* at, moving = the state at the end of a step, from its start q, qd and the increments r, v. */
static void eom_add_increments(real *at, real *moving, const real *q, const real *qd, const real *r, const real *v)
{
    for (int i = 0; i < EOM_NQ; i++) {
        at[i] = q[i] + r[i];
        moving[i] = qd[i] + v[i];
    }
}

#endif
/* Add the correction d to r, v, the end of a step from q, and return its size. */
#if EOM_INCREMENTS
static eom_correction_size eom_apply_correction(real *r, real *v, const real *at, const real *moving, const real *d)
#else
static eom_correction_size eom_apply_correction(real *r, real *v, const real *q, const real *d)
#endif
{
    enum { NQ = EOM_NQ };
    /*
     * Bounds of squares: relative correction whose second order is rounding; coordinate that counts as zero,
     * relative to all.
     */
    static const real SMALL = 8*EOM_EPS, ZERO = (real)1e-12;
    static const real STEP_WEIGHT = 100; /* squared: a correction is related to ten increments as well */
    eom_correction_size size = { 0, 0, 0, 0, 0 };

    for (int i = 0; i < NQ; i++)
#if EOM_INCREMENTS
        size.position += at[i]*at[i];
#else
        size.position += r[i]*r[i];
#endif
    for (int i = 0; i < NQ; i++) {
#if EOM_INCREMENTS
        const real x = at[i], xd = moving[i], step = r[i];
#else
        const real x = r[i], xd = v[i], step = r[i] - q[i];
#endif

        size.is_large |= d[i]*d[i] > SMALL*(x*x + STEP_WEIGHT*step*step + ZERO*size.position);
        r[i] += d[i];
        size.velocity += xd*xd;
        v[i] += d[NQ + i];
        size.position_change += d[i]*d[i];
        size.velocity_change += d[NQ + i]*d[NQ + i];
    }
    return size;
}

#if EOM_RATE_TERMS
/*
 * Whether the rate of a constraint equation that may be dropped as dependent is not zero at the state q, qd. Then
 * no motion satisfies all equations.
 */
static int eom_rates_contradict(const real *q, const real *qd, real t, const eom_model *m)
{
    enum { ROWS = EOM_CORRECTION_SIZE - 2*EOM_NQ };
    /* rates that are rounding: relative to the equation's own terms (three times the root of the tolerance of its
     * pivot), and to the largest terms of all equations */
#if EOM_SINGLE
    static const real OWN_PART = (real)1e-2, LARGEST_PART = (real)1e-4;
#else
    static const real OWN_PART = (real)1e-4, LARGEST_PART = (real)1e-9;
#endif
    real rates[2*ROWS], largest = 0;

    eom_evaluate_rate_terms(rates, q, qd, t, m);
    for (int k = ROWS; k < 2*ROWS; k++)
        largest = rates[k] > largest ? rates[k] : largest;
    for (int k = 0; k < ROWS; k++)
        if (eom_fabs(rates[k]) > OWN_PART*rates[ROWS + k] + LARGEST_PART*largest)
            return 1;
    return 0;
}

#endif
/*
 * Whether a correction is not the last one. The error of a correction is of second order: that of the velocities is
 * also the product of both corrections.
 */
static int eom_needs_correction(const eom_correction_size *size, real last_change, int pass, int *all_small)
{
    /* squares of relative corrections of q and qd near a singular position: small ones, and rounding */
#if EOM_SINGLE
    static const real SMALL_Q = (real)1e-6, SMALL_QD = (real)1e-2, ROUNDING = (real)1e5*64*EOM_EPS*EOM_EPS;
#else
    static const real SMALL_Q = (real)1e-8, SMALL_QD = (real)1e-4, ROUNDING = (real)1e9*64*EOM_EPS*EOM_EPS;
#endif
    static const real COUPLING = 900*EOM_EPS*EOM_EPS; /* square of 30 rounding errors, which velocity residuals have */
    const real change = size->position_change;
    int more = size->is_large, is_rounding;

    *all_small &= change <= SMALL_Q*(1 + size->position) && size->velocity_change <= SMALL_QD*size->velocity;
    more |= change*size->velocity_change > COUPLING*size->position*size->velocity;
    /* whether the correction is rounding, so that it no longer decreases by half */
    is_rounding = pass > 1 && change > last_change/4 && change <= ROUNDING*(1 + size->position);
    return more && !(*all_small && is_rounding);
}

/*
 * Project r, v, the end of a step from q, onto the constraints by Newton's method in the metric of D. Short steps
 * need one correction; further ones follow until the rest is rounding, which increases towards singular positions.
 * singular: whether an equation there depends on others and has no multiplier.
 */
#if EOM_SINES
/* r, v are the increments of q, qd in the step; s: sines and cosines at q + r, NULL if they are not known. */
static eom_status eom_project_end(real *r, real *v, const real *q, const real *qd, const eom_sines *s, real t, const eom_model *m, int *singular)
#else
#if EOM_INCREMENTS
/* r, v are the increments of q, qd in the step. */
static eom_status eom_project_end(real *r, real *v, const real *q, const real *qd, real t, const eom_model *m, int *singular)
#else
static eom_status eom_project_end(real *r, real *v, const real *q, real t, const eom_model *m, int *singular)
#endif
#endif
{
    enum { NQ = EOM_NQ, MAX_PASSES = 12 }; /* Newton's method needs two or three; near singular positions more */
    static const real DIVERGED = 100; /* squared ratio of a velocity correction to the velocity */
    real d[EOM_CORRECTION_SIZE], last_change = 0;
    int all_small = 1; /* whether all corrections were small; nearly flat equations may ask for huge ones */
#if EOM_INCREMENTS
    real at[EOM_WIDTH] = { 0 }, moving[EOM_WIDTH] = { 0 };
#else
    real *const at = r, *const moving = v;
#endif

    for (int pass = 0; pass < MAX_PASSES; pass++) {
        eom_correction_size size;
        int more;

#if EOM_INCREMENTS
        eom_add_increments(at, moving, q, qd, r, v);
#endif
#if EOM_SINES
        if (eom_evaluate_correction(d, at, moving, pass ? 0 : s, t, m))
#else
        if (eom_evaluate_correction(d, at, moving, t, m))
#endif
            return EOM_SINGULAR;
#if EOM_INCREMENTS
        size = eom_apply_correction(r, v, at, moving, d);
#else
        size = eom_apply_correction(r, v, q, d);
#endif
        if (size.is_large && size.velocity_change > DIVERGED*size.velocity)
            break; /* the velocity correction of nearly flat equations diverges */
        more = eom_needs_correction(&size, last_change, pass, &all_small);
        last_change = size.position_change;
        *singular = 0;
        for (int k = 2*NQ; k < EOM_CORRECTION_SIZE; k++)
            *singular |= d[k] == 0; /* the inverse pivot of an equation that was dropped */
#if EOM_RATE_TERMS
        if (!more && *singular) {
#if EOM_INCREMENTS
            eom_add_increments(at, moving, q, qd, r, v);
#endif
            if (eom_rates_contradict(at, moving, t, m))
                return EOM_LOCKED;
        }
#endif
        if (!more)
            return EOM_OK;
    }
    return EOM_LOCKED;
}

/* Project the stage q, qd onto the constraints to first order. Returns 1 if there is no correction, else 0. */
static int eom_project_stage(real *q, real *qd, real t, const eom_model *m)
{
    real d[EOM_CORRECTION_SIZE];

#if EOM_SINES
    if (eom_evaluate_correction(d, q, qd, 0, t, m))
#else
    if (eom_evaluate_correction(d, q, qd, t, m))
#endif
        return 1;
    for (int i = 0; i < EOM_NQ; i++) {
        q[i] += d[i];
        qd[i] += d[EOM_NQ + i];
    }
    return 0;
}
