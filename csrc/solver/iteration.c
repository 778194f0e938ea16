/* Iteration over the stages of a step, by fixed points or by Newton's method. */

/* Changes of the accelerations at the stages in an iteration. */
typedef struct {
    real square, last, prior; /* mean square of the relative changes; that of the iteration before, as it counts for the contraction rate; as it was */
    real along; /* Newton's method: inner product of the changes and those before, summed over the stages */
    real moved[EOM_NQ][EOM_GAUSS_STAGES]; /* Newton's method: the relative changes */
} eom_convergence;

/* The mean square of the relative changes from a to b. */
static inline real eom_squared_change(const eom_gauss_stages *a, const eom_gauss_stages *b, const real *scale)
{
    enum { S = EOM_GAUSS_STAGES };
    real squares[S] = { 0 };

    for (int k = 0; k < EOM_NQ; k++)
        EOM_LANES for (int i = 0; i < S; i++) {
            const real moved = scale[k]*(b->x[k][i] - a->x[k][i]);

            squares[i] += moved*moved;
        }
    return eom_sum(squares)/(real)S;
}

/* Measure the change from a to b. */
static void eom_measure_change(eom_convergence *c, const eom_gauss_stages *a, const eom_gauss_stages *b, const eom_solution *x)
{
    enum { S = EOM_GAUSS_STAGES };
    static const real FIRST_RATE = (real)0.09; /* least contraction that is assumed at first, squared */

    c->along = 0;
    for (int k = 0; x->newton && k < EOM_NQ; k++)
        for (int i = 0; i < S; i++) {
            const real moved = x->scale[k]*(b->x[k][i] - a->x[k][i]);

            c->along += moved*c->moved[k][i];
            c->moved[k][i] = moved;
        }
    c->square = eom_squared_change(a, b, x->scale);
    if (x->sweeps == 1)
        c->last = c->square;
    else if (x->sweeps == 2 && FIRST_RATE*c->last > c->square) /* the first was extrapolated */
        c->last = c->square/FIRST_RATE;
}

/*
 * Whether the iteration has converged: the remaining error, estimated from the contraction rate, is below tol/10, or
 * the changes are rounding errors. noise: size of changes, by coarse scales, that are rounding errors.
 */
static int eom_has_converged(const eom_convergence *c, const eom_gauss_stages *a, const eom_gauss_stages *b, const eom_solution *x, real tol, real noise)
{
    enum { S = EOM_GAUSS_STAGES };
    static const real CONVERGED = 8*EOM_EPS;
    static const real SLOWEST = (real)0.81; /* squared contraction rate of rounding errors */
    static const real ALIGNED = (real)0.5; /* cosine between two corrections above which they have a direction */
    const real enough = tol/10;
    /* with the rate change/last, change rate <= enough (1 - rate); first without the roots */
    const int converged = c->square*c->square <= enough*enough*c->last && c->square <= enough*(eom_sqrt(c->last) - eom_sqrt(c->square));

    if (x->newton) /* overestimated derivatives make changes small: these must decrease, or be rounding errors without a common direction */
        return x->sweeps > 1 && ((converged && c->square < SLOWEST*c->last) || (c->along <= ALIGNED*(real)S*eom_sqrt(c->square)*eom_sqrt(c->prior) && eom_squared_change(a, b, x->coarse) < noise*noise));
    return converged || c->square < CONVERGED*CONVERGED || (x->sweeps >= EOM_MIN_SWEEPS && c->square > SLOWEST*c->last && eom_squared_change(a, b, x->coarse) < noise*noise);
}

/* Whether the remaining iterations are too few to converge. */
static int eom_converges_too_slowly(const eom_convergence *c, const eom_solution *x, real tol)
{
    real rate, fifth;

    if (x->sweeps < EOM_MIN_SWEEPS)
        return 0;
    rate = c->square/c->last;
    fifth = rate*rate*rate*rate*rate;
    return fifth*fifth*c->square > tol/10*tol/10;
}

/* Compute the scales of the error at the first iteration from a to b. */
static void eom_begin_scales(eom_solution *x, const eom_gauss_stages *a, const eom_gauss_stages *b, const real *q, const real *qd, real h, real tol)
{
    static const real ROUNDING = 2, STIFF_ROUNDING = 8192; /* rounding units of q, as an acceleration */

    /* the extrapolated stages of a long stiff step are no scale */
    eom_error_scales(x->scale, x->coarse, x->newton ? b : a, q, qd, h, (x->newton ? STIFF_ROUNDING : ROUNDING)*EOM_EPS/tol);
#if EOM_REST
    for (int k = 0; x->capped && k < EOM_NQ; k++) {
        x->scale[k] = x->scale[k] > x->cap[k] ? x->cap[k] : x->scale[k];
        x->coarse[k] = x->coarse[k] > x->cap[k] ? x->cap[k] : x->coarse[k];
    }
#endif
}

#if EOM_CONSTRAINTS
/* The iterate of the least change: near a singular position rounding errors are large and do not contract. */
typedef struct {
    eom_gauss_stages a;
    real square, noise, fair; /* its change squared; what counts as rounding error; what is accepted */
} eom_best_iterate;

/* Store the iterate of the least change, of the iteration from a to b. */
static void eom_update_best(eom_best_iterate *best, const eom_gauss_stages *a, const eom_gauss_stages *b, const eom_solution *x)
{
    const real square = eom_squared_change(a, b, x->coarse);

    if (square < best->square && (square < best->noise*best->noise || x->sweeps == 1)) {
        best->square = square;
        best->a = square < best->noise*best->noise ? *b : *a;
    }
}

#endif
/* b = the iterate after a, and its changes c. Returns 0 if some accelerations do not exist. */
static int eom_iterate(eom_gauss_stages *b, const eom_gauss_stages *a, eom_convergence *c, eom_solution *x, const real *q, const real *qd, real t, real h, real tol, const eom_model *m)
{
#if EOM_CONSTRAINTS
    const int exist = eom_gauss_sweep(b, a, q, qd, t, h, x->project, m);
#else
    const int exist = eom_gauss_sweep(b, a, q, qd, t, h, m);
#endif

    if (x->newton)
        eom_newton_correction(b, a, &x->newton_data);
    if (x->sweeps == 1)
        eom_begin_scales(x, a, b, q, qd, h, tol);
    eom_measure_change(c, a, b, x);
    return exist;
}

/* Estimate the error of a step with the accelerations a at its stages. */
static void eom_estimate_roughness(eom_solution *x, const eom_gauss_stages *a)
{
    static const real FLAT = (real)0.05; /* see eom_roughness: few */

    x->rough = eom_roughness(a, x->scale, x->coarse, x->newton ? 0 : FLAT, &x->beyond);
}

/*
 * x->a = the accelerations at the stages of a step, by iteration from x->a. x->sweeps = the number of iterations.
 * A step that is rougher than `most` after two iterations is given up.
#if EOM_CONSTRAINTS
 * If the stages are projected onto the constraints, the iterate with the least change is accepted.
#endif
 */
static eom_outcome eom_solve_stages(eom_solution *x, const real *q, const real *qd, real t, real h, real tol, real most, const eom_model *m)
{
    static const real NOISE = 1000; /* rounding units of corrections that are rounding errors */
    int ends = 0; /* whether the iteration is expected to be the last */
    eom_convergence c;
    eom_gauss_stages other, *from = &other, *to = &x->a;
    eom_outcome outcome = EOM_NOT_CONVERGED;
#if EOM_CONSTRAINTS
    static const real FAIR = 64; /* multiple of the noise that is accepted after two rejected steps */
    const real noise = x->project ? EOM_SQRT_EPS : NOISE*EOM_EPS;
    eom_best_iterate best;

    best.noise = noise;
    best.fair = x->project > 2 ? FAIR*noise : noise;
    best.square = best.fair*best.fair;
    if (x->project)
        best.a = x->a;
#else
    const real noise = NOISE*EOM_EPS;
#endif

    memset(&c, 0, sizeof c);
    x->rough = x->beyond = 0;
    for (x->sweeps = 1; x->sweeps <= EOM_MAX_SWEEPS; ++x->sweeps) {
        eom_gauss_stages *const swapped = from;
        int exist;

        from = to;
        to = swapped;
        exist = eom_iterate(to, from, &c, x, q, qd, t, h, tol, m);
        if (!exist || !(c.square - c.square == 0)) {
            outcome = EOM_UNDEFINED;
            break;
        }
#if EOM_CONSTRAINTS
        if (x->project)
            eom_update_best(&best, from, to, x);
#endif
        if (ends) /* at once with the iteration: its result hardly differs */
            eom_estimate_roughness(x, from);
        if (eom_has_converged(&c, from, to, x, tol, noise))
            outcome = EOM_CONVERGED;
        if (x->sweeps == 2 || (outcome == EOM_CONVERGED && (!ends || x->beyond > 0)))
            eom_estimate_roughness(x, to);
        if (outcome == EOM_CONVERGED || (x->sweeps == 2 && x->rough > most) || eom_converges_too_slowly(&c, x, tol))
            break;
        ends = c.square*c.square*c.square <= tol/10*tol/10*c.last*c.last; /* with the same rate */
        c.last = c.prior = c.square;
    }
#if EOM_CONSTRAINTS
    if (x->project && outcome != EOM_CONVERGED && best.square < best.fair*best.fair) {
        eom_estimate_roughness(x, &best.a);
        outcome = EOM_CONVERGED;
        to = &best.a;
    }
#endif
    if (to != &x->a)
        x->a = *to;
    return outcome;
}

#if EOM_REST
/*
 * x->cap[k] = the scale by which the rounding error of acceleration k is tol/200, or eps. The forces on bodies that
 * stick cancel, and only their rounding error is left at rest, which no step size resolves. The rounding error is
 * the difference of two iterations from x->a at times a few ulp apart. x->capped = whether it is above tol/20 by
 * one of the scales.
 */
static void eom_cap_scales(eom_solution *x, const real *q, const real *qd, real t, real h, real tol, const eom_model *m)
{
    enum { S = EOM_GAUSS_STAGES, NQ = EOM_NQ };
    const real least = tol/200 > EOM_EPS ? tol/200 : EOM_EPS, later = t + 2*EOM_EPS*(eom_fabs(t) + eom_fabs(h));
    eom_gauss_stages first, second;
    int exist, most = 0;

#if EOM_CONSTRAINTS
    exist = eom_gauss_sweep(&first, &x->a, q, qd, t, h, x->project, m);
    exist = eom_gauss_sweep(&second, &x->a, q, qd, later, h, x->project, m) && exist;
#else
    exist = eom_gauss_sweep(&first, &x->a, q, qd, t, h, m);
    exist = eom_gauss_sweep(&second, &x->a, q, qd, later, h, m) && exist;
#endif
    for (int k = 0; k < NQ; k++) {
        real noise = EOM_TINY;

        for (int i = 0; exist && i < S; i++) {
            const real by = eom_fabs(second.x[k][i] - first.x[k][i]);

            noise = by > noise ? by : noise;
        }
        x->cap[k] = least/noise;
        most |= noise*x->scale[k] > 10*least;
    }
    x->capped = exist && most;
}

#endif
