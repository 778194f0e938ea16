/* Step-size control: scales of the error, its estimate, the first and the next step size. */

/* The admissible size, relative to that of an accepted step: at least. */
static const real eom_accepted_factor = (real)0.8;

/* The same: at most. */
static const real eom_max_factor = 10;

/* h^2 over the smaller of the measures of a position and a velocity, see eom_error_scales. */
static inline real eom_error_scale(real of_q, real of_v, real h, real least)
{
    of_v = of_v > least*of_q ? of_v : least*of_q;
    return h*h/(of_v < of_q ? of_v : of_q);
}

/*
 * scale[k]: the relative change of velocity or position k, the larger of both, over a step of size h, for a
 * change of its acceleration by 1. Velocities are measured by h times their magnitude, plus a part of the largest;
 * positions by how far they move, plus a part of the largest; a velocity smaller than `least` times the measure of
 * its position by that. coarse[k]: with a larger part, by which rounding errors of the largest are small in all.
 */
static void eom_error_scales(real *scale, real *coarse, const eom_gauss_stages *a, const real *q, const real *qd, real h, real least)
{
#if EOM_DISCRETE
    enum { NQ = EOM_NQ, SCALED = NQ - EOM_DISCRETE, MIDDLE = EOM_GAUSS_STAGES/2 }; /* only jumps change discrete coordinates */
#else
    enum { NQ = EOM_NQ, SCALED = NQ, MIDDLE = EOM_GAUSS_STAGES/2 };
#endif
    real moved[NQ], going[NQ], far = EOM_TINY, fast = EOM_TINY;

    for (int k = 0; k < SCALED; k++) {
        const real gained = h*a->x[k][MIDDLE], most = eom_fabs(qd[k]) > eom_fabs(qd[k] + gained) ? eom_fabs(qd[k]) : eom_fabs(qd[k] + gained);

        going[k] = most + eom_fabs(gained);
        moved[k] = eom_fabs(q[k]) + h*(eom_fabs(qd[k]) + eom_fabs(gained));
        fast = going[k] > fast ? going[k] : fast;
        far = moved[k] > far ? moved[k] : far;
    }
    for (int k = 0; k < SCALED; k++) {
        scale[k] = eom_error_scale(moved[k] + EOM_SCALE_FLOOR*far, h*(going[k] + EOM_SCALE_FLOOR*fast), h, least);
        coarse[k] = eom_error_scale(moved[k] + EOM_COARSE_FLOOR*far, h*(going[k] + EOM_COARSE_FLOOR*fast), h, least);
    }
#if EOM_DISCRETE
    for (int k = SCALED; k < NQ; k++)
        scale[k] = coarse[k] = 0;
#endif
}

/*
 * With the last four Legendre coefficients b4 to b7 of an acceleration: high = b6^2 + b7^2, low = b4^2 + b5^2,
 * last = b7^2 + 0.04 b6^2.
 */
static void eom_last_coefficients(const real *a, real *high, real *low, real *last)
{
    enum { S = EOM_GAUSS_STAGES };
    real part[4] = { 0 }, odd[4] = { 0 };

    for (int i = 0; i < S; i += 2) {
        EOM_LANES for (int j = 0; j < 4; j++)
            part[j] += eom_gauss_last[i][j]*a[i];
        EOM_LANES for (int j = 0; j < 4; j++)
            odd[j] += eom_gauss_last[i + 1][j]*a[i + 1];
    }
    EOM_LANES for (int j = 0; j < 4; j++) {
        part[j] += odd[j];
        part[j] *= part[j];
    }
    *low = part[0] + part[1];
    *high = part[2] + part[3];
    *last = part[3] + (real)0.04*part[2];
}

/*
 * The roughness of a step: the largest relative size of the last Legendre coefficients. *beyond = an estimate of
 * the next coefficient, from the last two and their decrease from the two before, for the coordinates in which they
 * hardly decrease (high > few*low); relative to coarse scales, since rounding errors hardly decrease either. 0 if
 * there are none.
 */
static real eom_roughness(const eom_gauss_stages *a, const real *scale, const real *coarse, real few, real *beyond)
{
    real most = 0, next = 0;

    for (int k = 0; k < EOM_NQ; k++) {
        real high, low, last;

        eom_last_coefficients(a->x[k], &high, &low, &last);
        last *= scale[k]*scale[k];
        most = last > most ? last : most;
        if (high > few*low) {
            const real size = (high < low ? high*(high/low) : high)*coarse[k]*coarse[k];

            next = size > next ? size : next;
        }
    }
    *beyond = eom_sqrt(next);
    return eom_sqrt(most);
}

/*
 * s->h = the size of the first step, from the time scale of the motion. s->span = the remaining time, at most
 * EOM_LONGEST time scales of the motion, so that a distant t_end does not matter.
 */
static void eom_initial_step_size(eom_run_state *s, const real *a, real t_end)
{
#if EOM_DISCRETE
    enum { SCALED = EOM_NQ - EOM_DISCRETE };
#else
    enum { SCALED = EOM_NQ };
#endif
    static const real RANGE = 100; /* coordinates below that part of the largest count as that part */
    static const real FIRST_SIZE = (real)0.05, LONGEST = EOM_LONGEST; /* size and span in time scales of the motion */
    static const real MANY_TIME_SCALES = 50, LEAST_STEPS = 1000; /* if the span has fewer: that many steps */
    static const real LEAST_SIZE = 256*EOM_EPS; /* relative to t: where all coordinates are zero within rounding, they are no scale */
    const real *const q = s->q, *const qd = s->qd;
    real far = 0, fast = 0, most = 0;

    for (int k = 0; k < SCALED; k++) {
        far = eom_fabs(q[k]) > far ? eom_fabs(q[k]) : far;
        fast = eom_fabs(qd[k]) > fast ? eom_fabs(qd[k]) : fast;
    }
    for (int k = 0; k < SCALED; k++) {
        const real moved = eom_fabs(q[k]) + far/RANGE, going = eom_fabs(qd[k]) + fast/RANGE;
        real rate = moved > 0 ? eom_fabs(qd[k])/moved : 0, other = 0;

        if (going > 0)
            other = eom_fabs(a[k])/going;
        if (moved > 0 && !(going > 0 && other*other <= eom_fabs(a[k])/moved)) /* from rest */
            other = eom_sqrt(eom_fabs(a[k])/moved);
        rate = other > rate ? other : rate;
        most = rate > most ? rate : most;
    }
    s->span = most*(t_end - s->t) > LONGEST ? LONGEST/most : t_end - s->t;
    s->h = most*s->span > MANY_TIME_SCALES ? FIRST_SIZE/most : s->span/LEAST_STEPS;
    s->h = s->h > LEAST_SIZE*eom_fabs(s->t) ? s->h : LEAST_SIZE*eom_fabs(s->t);
}

/* The size below which a step is not reduced. */
static real eom_least_step_size(const eom_run_state *s)
{
    return 4*EOM_EPS*(eom_fabs(s->t) + s->span);
}

/* Choose between fixed-point iteration and Newton's method for the next step; ideal: admissible size of this one. */
static void eom_update_stiffness(eom_run_state *s, const eom_attempt *a, real ideal, eom_output *output)
{
    s->used_newton = a->x.newton;
    if (a->x.newton) {
        output->stiff_steps++;
        s->newton_steps--;
    } else if (a->x.sweeps > EOM_SLOW_SWEEPS && ideal > 3*a->h) {
        s->stiff_votes += 2; /* convergence limits the size, not the error */
        s->newton_steps = s->stiff_votes > EOM_STIFF_VOTES ? EOM_NEWTON_STEPS : 0;
    } else if (a->x.sweeps < 5 || ideal < 2*a->h) {
        s->stiff_votes -= s->stiff_votes > 0;
    }
    s->stiff_votes = s->stiff_votes > EOM_MAX_VOTES ? EOM_MAX_VOTES : s->stiff_votes;
}

/*
 * s->h = the size of the next step. The admissible sizes of the last two steps are extrapolated linearly in time
 * (predictive control, as Gustafsson, ACM Trans. Math. Softw. 20 (1994), 496).
 */
static void eom_choose_next_size(eom_run_state *s, const eom_attempt *a, real ideal, real middle)
{
    static const real MAX_SLOPE = (real)0.8, MIN_SLOPE = (real)-1.5; /* of the admissible size as a function of time */
    static const real FIRST_GROWTH = 4, MAX_GROWTH = (real)1.7; /* of sizes of steps: after a restart, otherwise */
    static const real MAX_SHRINK = 5; /* ratio of the sizes of two steps */
    static const real SAFETY = (real)0.95; /* of the admissible size */
    const real h = a->h, span = s->ideal > 0 && middle > s->ideal_time ? middle - s->ideal_time : h;
    real more = s->ideal > 0 ? ideal - s->ideal : 0, growth, next;

    more = more > MAX_SLOPE*span ? MAX_SLOPE*span : more < MIN_SLOPE*span ? MIN_SLOPE*span : more;
#if EOM_KINKS
    growth = s->steps_since_restart < 2 || a->factor > 4 ? FIRST_GROWTH : MAX_GROWTH;
#else
    growth = s->steps_since_restart < 2 ? FIRST_GROWTH : MAX_GROWTH;
#endif
    if (a->x.sweeps > EOM_SLOW_SWEEPS && growth > (real)EOM_SLOW_SWEEPS/(real)a->x.sweeps)
        growth = (real)EOM_SLOW_SWEEPS/(real)a->x.sweeps;
    if (a->rejected && growth > 1)
        growth = 1;
    next = SAFETY*(ideal*span + more*h/2)/(span - more/2); /* on a line with the slope more/span */
    next = next > growth*h ? growth*h : next < h/MAX_SHRINK ? h/MAX_SHRINK : next;
    s->h = a->ends && !a->rejected && a->planned > next ? a->planned : next;
}
