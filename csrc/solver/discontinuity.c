/* Steps with discontinuities and kinks of the forces. */

/*
 * The error of a step with a discontinuity or kink of the forces, relative to the largest coordinates and
 * velocities so far, by coarse scales; *smooth: that of the coordinates in which the step is smooth, by fine scales.
 * from, to: the accelerations at both ends. cap: largest scales, NULL for none.
 *
 * Legendre coefficients of a smooth acceleration decrease fast, those of one with a kink hardly. The estimate is
 * the last two coefficients times their ratio to the two before. It exceeds the error of smooth motion, so that no
 * small kink is overlooked. A kink between an end and the next node affects that end only: there the polynomial
 * deviates from the acceleration, over a fiftieth of the step.
 */
static real eom_kink_error(const eom_gauss_stages *a, const eom_run_state *s, const real *from, const real *to, real h, const real *cap, real *smooth)
{
    enum { NQ = EOM_NQ, MIDDLE = EOM_GAUSS_STAGES/2 };
    static const real SLOW_DECREASE = (real)0.0225; /* 0.15 squared, from one pair of coefficients to the next; smooth ones fall faster */
    static const real DEVIATION = (real)0.1, END_PART = (real)4e-4; /* squared: at an end; over a fiftieth of the step */
    real far = EOM_TINY, fast = EOM_TINY, most = 0, even = 0;

    for (int k = 0; k < NQ; k++) {
        far = s->max_q[k] > far ? s->max_q[k] : far;
        fast = s->max_qd[k] > fast ? s->max_qd[k] : fast;
    }
    for (int k = 0; k < NQ; k++) {
        const real gained = h*eom_fabs(a->x[k][MIDDLE]);
        const real of_q = s->max_q[k] + h*(s->max_qd[k] + gained), of_v = h*(s->max_qd[k] + gained);
        real scale = eom_error_scale(of_q + EOM_SCALE_FLOOR*far, of_v + h*EOM_SCALE_FLOOR*fast, h, 0);
        real coarse = eom_error_scale(of_q + EOM_COARSE_FLOOR*far, of_v + h*EOM_COARSE_FLOOR*fast, h, 0);
        const real at_from = eom_weighted_sum(eom_gauss_ends[0], a->x[k]) - from[k], at_to = eom_weighted_sum(eom_gauss_ends[1], a->x[k]) - to[k];
        const real off = at_from*at_from > at_to*at_to ? at_from*at_from : at_to*at_to;
        real low, high, last, size = 0;

        scale = cap && cap[k] < scale ? cap[k] : scale;
        coarse = cap && cap[k] < coarse ? cap[k] : coarse;
        eom_last_coefficients(a->x[k], &high, &low, &last);
        size = high < low ? high*(high/low) : high;
        if (high > SLOW_DECREASE*low)
            most = size*coarse*coarse > most ? size*coarse*coarse : most;
        else
            even = size*scale*scale > even ? size*scale*scale : even;
        size = off > DEVIATION*high ? END_PART*off*coarse*coarse : 0;
        most = size > most ? size : most;
    }
    *smooth = eom_sqrt(even);
    return eom_sqrt(most);
}

/* The part of the tolerance that applies to the error of a step with a kink, besides rounding errors. */
static real eom_kink_tolerance(real tol)
{
    static const real SHARE = (real)0.1, ROUNDING = 8; /* of the tolerance; rounding units */

    return SHARE*tol + ROUNDING*EOM_EPS;
}

/* Estimate the error of an attempt whose iteration has converged, with its kinks. a->factor = the admissible size. */
static void eom_assess_kink(eom_attempt *a, const eom_run_state *s, real tol, const eom_model *m, eom_output *output)
{
    static const real SAFETY = (real)0.95, CLOSE_SAFETY = (real)0.85; /* of the admissible size: with a kink; of smooth forces */
    static const real LEAST = 1e8; /* a smaller error than the tolerance over that counts as that */
    const real part = eom_kink_tolerance(tol);
    real end_q[EOM_WIDTH] = { 0 }, end_qd[EOM_WIDTH] = { 0 }, smooth;

    eom_step_end(end_q, end_qd, &a->x.a, s->q, s->qd, a->h);
    output->evaluations++;
    if (eom_accelerate(a->end_f, end_q, end_qd, s->t + a->h, m))
        a->outcome = EOM_UNDEFINED;
#if EOM_REST
    a->kink_error = eom_kink_error(&a->x.a, s, a->f, a->end_f, a->h, a->x.capped ? a->x.cap : 0, &smooth)/part;
#else
    a->kink_error = eom_kink_error(&a->x.a, s, a->f, a->end_f, a->h, 0, &smooth)/part;
#endif
    /* the error of smooth forces is of order eight or more in the size, that of a kink of order one or two */
    smooth = CLOSE_SAFETY*eom_sqrt(eom_sqrt(eom_sqrt(part/(smooth > part/LEAST ? smooth : part/LEAST))));
    a->factor = smooth < a->factor ? smooth : a->factor;
    if (a->outcome == EOM_CONVERGED && a->kink_error > 1)
        a->factor = a->kink_error > 4 ? SAFETY/eom_sqrt(a->kink_error) : (real)0.5;
}

/*
 * Whether a step of the least size is accepted although its error is too large: at a jump of the forces, which no
 * step size resolves, but not where the forces jump repeatedly.
 */
static int eom_skip_kink(eom_run_state *s, real least)
{
    enum { MAX_SKIPPED = 20 }; /* kinks in a row */
    static const real REPEATED = EOM_REPEATED_KINKS; /* least sizes within which kinks follow one another */

    s->skipped_kinks = s->skipped_kinks > 0 && s->t - s->skipped_kink_time < REPEATED*least ? s->skipped_kinks + 1 : 1;
    s->skipped_kink_time = s->t;
    return s->skipped_kinks <= MAX_SKIPPED;
}

/* Count steps with kinks. Returns 0 if many of them have made no progress, for example with friction that would stick. */
static int eom_makes_progress(eom_run_state *s, const eom_attempt *a)
{
    enum { MAX_KINKS = 1000 }; /* steps with kinks after which the run must have made progress */
    static const real KINK = (real)0.3; /* error relative to its bound above which a step has a kink */
    static const real PROGRESS_T = (real)1e-3, PROGRESS_Q = (real)3e-3; /* relative, in these steps */

    s->kink = a->kink_error > KINK;
    if ((s->kink || a->rejected) && s->recent_kinks++ == 0) {
        s->first_kink_time = s->t;
    } else if (s->recent_kinks > MAX_KINKS) {
        const real since = s->t - s->first_kink_time;
        int progress = since > PROGRESS_T*(eom_fabs(s->t) + s->span);

        for (int k = 0; k < EOM_NQ; k++) /* relative to the largest motion in that time */
            progress |= since*s->max_qd[k] > PROGRESS_Q*s->max_q[k];
        if (!progress)
            return 0;
        s->recent_kinks = 0;
    }
    return 1;
}
