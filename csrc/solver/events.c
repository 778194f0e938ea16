/* Detection of events in a step (Shampine & Thompson, Computers and Mathematics with Applications 39 (2000), 43). */

#if EOM_ADAPTIVE
/* An event function in a part of the last step. Values are relative to that at the last root. */
#else
/* An event function in the last step. Values are relative to that at the last root. */
#endif
typedef struct {
    real g[EOM_SAMPLES], c[EOM_SAMPLES]; /* values at the Chebyshev nodes, and their series */
    real largest, change; /* largest magnitude; largest change between nodes */
    int is_far; /* whether its values are so far from zero that there is no root */
#if EOM_JUMPS
    int is_driven; /* whether it is driven through a contact, visibly after `from` */
#endif
    real from; /* roots before this fraction z are ignored */
    real high, slope; /* end of the interval of the last root; derivative by z there */
#if EOM_INITIAL_EVENTS
    real noise; /* depth below zero that counts as rounding for an event that leaves zero upwards */
#endif
} eom_event_samples;

#if EOM_ADAPTIVE
/* A root of event k: its fraction z of the part of the step, its time, and the state and the event functions there. */
#else
/* A root of event k: its fraction z of the step, and the state and the event functions there. */
#endif
typedef struct {
    int k;
    real z, t, q[EOM_NQ], qd[EOM_NQ], value[EOM_NE];
    real scale; /* largest magnitude of the event function in the step */
#if !EOM_ONLY_JUMPS
    long limit; /* number of events at which the step ends */
#endif
#if EOM_JUMPS
    real height; /* its largest magnitude between the start of the step and the root */
    int hidden; /* whether no significant value precedes the root */
#endif
} eom_root;

/* The larger of two numbers; b if a is NaN. */
static real eom_greater(real a, real b)
{
    return a > b ? a : b;
}

/* The rounding error of event function k: its largest change if the state varies by rounding. */
static real eom_event_rounding(int k, const real *q, const real *qd, real t, const eom_model *m)
{
    static const real PERTURBATION = 4*EOM_EPS; /* relative */
    real q_at[EOM_NQ], qd_at[EOM_NQ], value[EOM_NE], here = 0, most = 0;

    for (int n = 0; n < 5; n++) { /* none, all up, alternating; the last two with qd reversed */
        for (int i = 0; i < EOM_NQ; i++) {
            const real by = n == 0 ? 0 : n % 2 == 0 && i % 2 ? -PERTURBATION : PERTURBATION;

            q_at[i] = q[i]*(1 + by);
            qd_at[i] = qd[i]*(1 + (n > 2 ? -by : by));
        }
        eom_event_functions(value, q_at, qd_at, t*(1 + (n ? PERTURBATION : 0)), m);
        here = n ? here : value[k];
        most = eom_greater(eom_fabs(value[k] - here), most);
    }
    return most;
}

#if EOM_ADAPTIVE
/* Event function k at the fraction z of the part of the last step, by the interpolant. */
#else
/* Event function k at the fraction z of the last step, by the interpolant. */
#endif
static real eom_evaluate_event(int k, real z, const eom_run_state *s, const eom_model *m)
{
    real q[EOM_NQ], qd[EOM_NQ], value[EOM_NE];
#if EOM_ADAPTIVE
    const real of_step = s->part_start + z*s->part_width;

    eom_interpolate(q, qd, s, of_step);
    eom_event_functions(value, q, qd, s->t0 + of_step*s->size, m);
#else

    eom_interpolate(q, qd, s, z);
    eom_event_functions(value, q, qd, s->t0 + z*s->size, m);
#endif
    return value[k] - s->event[k].offset;
}

#if EOM_JUMPS
/*
 * The sign that event function k has after the start of the step: its own sign there if it is not zero. Otherwise that of
 * its first value above rounding errors at the fractions 5e-7*4^n, since a function that leaves zero may return before the
 * first node; or that at the end of the step. 0, and e->is_driven: a jump left it at zero without a rate, and the
 * acceleration drives it on: it is a z + b z^2, as g(16 z) - 20 g(4 z) + 64 g(z) vanishes, and b z^2 prevails.
 */
static int eom_leaving_sign(int k, eom_event_samples *e, const eom_run_state *s, const eom_model *m)
#else
/*
 * The sign that event function k has after the start of the step: its own sign there if it is not zero. Otherwise that of
 * its first value above rounding errors at the fractions 5e-7*4^n, since a function that leaves zero may return before the
 * first node; or that at the end of the step.
 */
static int eom_leaving_sign(int k, const eom_event_samples *e, const eom_run_state *s, const eom_model *m)
#endif
{
    const real rounding = 8*(eom_fabs(e->g[0]) + eom_event_rounding(k, s->q0, s->qd0, s->t0, m));

#if EOM_INITIAL_EVENTS
    if (eom_above[k])
        return 1;
#endif
    if (s->event[k].offset == 0 && eom_fabs(e->g[0]) > EOM_CLOSE*e->largest)
        return e->g[0] > 0 ? 1 : -1;
    for (real z = (real)5e-7; z < 1; z *= 4) {
        const real value = eom_evaluate_event(k, z, s, m);

#if EOM_JUMPS
        if (eom_fabs(value) > rounding) {
            const real g4 = eom_evaluate_event(k, 4*z, s, m), g16 = eom_evaluate_event(k, 16*z, s, m);
            const int is_square = eom_fabs(g16) > 8*eom_fabs(g4) && eom_fabs(g16 - 20*g4 + 64*value) < eom_fabs(g16)/16;

            e->is_driven = is_square && value*(real)s->event[k].contact < 0;
#if EOM_SEVERAL
            e->from = e->is_driven ? z : 0;
#endif
            return e->is_driven ? 0 : value > 0 ? 1 : -1;
        }
#else
        if (eom_fabs(value) > rounding)
            return value > 0 ? 1 : -1;
#endif
    }
    return (e->g[EOM_SAMPLES - 1] > 0) - (e->g[EOM_SAMPLES - 1] < 0);
}

/* Sample the event functions, fit their series, set unknown signs. Returns 1 + the index of a NaN. */
static int eom_sample_events(eom_event_samples *samples, eom_run_state *s, const eom_model *m)
{
#if EOM_ADAPTIVE
    for (int j = 0; j < EOM_SAMPLES; j++) {
        real q[EOM_NQ], qd[EOM_NQ], value[EOM_NE];
        const real z = s->part_start + eom_nodes[j]*s->part_width;

        if (s->part_width < 1)
            eom_interpolate(q, qd, s, z);
        else
            eom_interpolate_node(q, qd, s, j);
        eom_event_functions(value, q, qd, s->t0 + z*s->size, m);
        for (int k = 0; k < EOM_NE; k++)
            samples[k].g[j] = value[k] - s->event[k].offset;
    }
#else
#if EOM_SEVERAL
    for (int j = 0; j < EOM_SAMPLES; j++) {
        real q[EOM_NQ], qd[EOM_NQ], value[EOM_NE];

        eom_interpolate(q, qd, s, eom_nodes[j]);
        eom_event_functions(value, q, qd, s->t0 + eom_nodes[j]*s->size, m);
        for (int k = 0; k < EOM_NE; k++)
            samples[k].g[j] = value[k] - s->event[k].offset;
    }
#else
    for (int j = 0; j < EOM_SAMPLES; j++)
        samples->g[j] = eom_evaluate_event(0, eom_nodes[j], s, m);
#endif
#endif
    for (int k = 0; k < EOM_NE; k++) {
        eom_event_samples *const e = &samples[k];

        e->largest = eom_fabs(e->g[0]);
        e->change = e->from = 0;
#if EOM_JUMPS
        e->is_driven = 0;
#endif
        for (int j = 0; j < EOM_SAMPLES; j++)
            if (e->g[j] != e->g[j])
                return k + 1;
        for (int j = 1; j < EOM_SAMPLES; j++) {
            e->largest = eom_greater(eom_fabs(e->g[j]), e->largest);
            e->change = eom_greater(eom_fabs(e->g[j] - e->g[j - 1]), e->change);
        }
        e->is_far = eom_fabs(e->g[0]) > 12*e->change; /* 8 intervals, with a margin of 1.5 */
        if (!e->is_far)
            eom_fit_series(e->c, e->g);
        if (s->event[k].sign == 0)
            s->event[k].sign = eom_leaving_sign(k, e, s, m);
    }
    return 0;
}

#if EOM_SEVERAL
/*
 * The first fraction after samples->from at which event function k, which has this sign there, crosses zero; 2: there is
 * none. Of one that is driven: samples->from. If the function approaches zero and recedes in an interval at whose ends it
 * has this sign, the crossing may be before its extremum.
 */
#else
/*
 * The first fraction after samples->from at which event function k, which has this sign there, crosses zero; 2: there is
 * none. If the function approaches zero and recedes in an interval at whose ends it has this sign, the crossing may be
 * before its extremum.
 */
#endif
#if EOM_INITIAL_EVENTS
static real eom_find_root(int k, real sign, eom_event_samples *samples)
#else
static real eom_find_root(real sign, eom_event_samples *samples)
#endif
{
    const real *const c = samples->c, rounding = 64*EOM_EPS*samples->change;
#if EOM_INITIAL_EVENTS
    const real below = eom_above[k] ? rounding + samples->noise : 0;
#endif
    real d[EOM_SAMPLES], low = samples->from, slope_high;

#if EOM_SEVERAL
#if EOM_JUMPS
    if (samples->is_driven)
        return samples->from;
#endif
#endif
    if (samples->is_far)
        return 2;
    eom_differentiate_series(d, c);
    slope_high = eom_evaluate_series(d, low);
    for (int j = 1; j < EOM_SAMPLES; j++) {
        const real slope_low = slope_high;
#if EOM_INITIAL_EVENTS
        real high = eom_nodes[j], value = samples->g[j], threshold = below;
#else
        real high = eom_nodes[j], value = samples->g[j], threshold = 0;
#endif

        if (high <= low)
            continue;
        slope_high = eom_evaluate_series(d, high);
        if (sign*value >= -threshold && sign*slope_low < 0 && sign*slope_high > 0) {
            high = eom_find_zero(d, -sign, low, high);
            value = eom_evaluate_series(c, high);
            threshold = eom_greater(threshold, rounding);
        }
        if (sign*value < -threshold) {
            const real z = eom_find_zero(c, sign, low, high);

            samples->high = high;
            samples->slope = eom_evaluate_series(d, z);
            return z;
        }
        low = eom_nodes[j];
    }
    return 2;
}

/* Store an event in the next row of events; output->which NULL: count it only. */
static void eom_record_event(eom_output *output, const eom_root *x)
{
#if EOM_INITIAL_EVENTS
    if (output->which && output->events >= output->room)
        return;
#endif
    if (output->which) {
        real *const row = output->event_rows + (1 + 2*EOM_NQ)*output->events;

        output->which[output->events] = x->k;
        row[0] = x->t;
        eom_copy_state(row + 1, row + 1 + EOM_NQ, x->q, x->qd);
    }
    output->events++;
}

#if EOM_ADAPTIVE
/*
 * Whether the nodes resolve the event functions in the part of an adaptive step: their last Chebyshev coefficients are
 * small, or they are far from zero, or they are rounding errors.
 */
static int eom_is_resolved(const eom_run_state *s, const eom_event_samples *samples, const eom_model *m)
{
    enum { LAST = EOM_SAMPLES - 1 };
    static const real MAX_TAIL = (real)0.02, FAR = 4; /* last coefficients, relative to the largest value; least value, relative to them */
    static const real CLOSE = EOM_CLOSE, MARGIN = 1024; /* relative to the largest value so far; of rounding errors */

    for (int k = 0; k < EOM_NE; k++) {
        const eom_event_samples *const e = &samples[k];
        const real tail = e->is_far ? 0 : eom_fabs(e->c[LAST]) + eom_fabs(e->c[LAST - 1]);
        real least = eom_fabs(e->g[0]);

        for (int j = 1; j <= LAST; j++)
            least = -eom_greater(e->g[0] > 0 ? -e->g[j] : e->g[j], -least);
        if (tail > MAX_TAIL*e->largest && least < FAR*tail && e->largest > CLOSE*s->event[k].largest && e->largest > MARGIN*eom_event_rounding(k, s->q, s->qd, s->t, m))
            return 0;
    }
    return 1;
}

#endif
#if EOM_INITIAL_EVENTS
/* A body at rest under friction moves by rounding errors, which the end of the step does not have. */
static void eom_measure_event_noise(eom_event_samples *samples, const eom_run_state *s, const eom_model *m)
{
    static const real NOISE = 16; /* multiple of the deviation of the interpolant that counts as rounding */
    real q[EOM_NQ], qd[EOM_NQ], value[EOM_NE], interpolated[EOM_NE];

#if EOM_ADAPTIVE
    eom_event_functions(value, s->fixed ? s->by_q : s->q, s->fixed ? s->by_qd : s->qd, s->t, m);
#else
    eom_event_functions(value, s->by_q, s->by_qd, s->t, m);
#endif
    eom_interpolate(q, qd, s, 1);
    eom_event_functions(interpolated, q, qd, s->t, m);
    for (int k = 0; k < EOM_NE; k++)
        samples[k].noise = NOISE*eom_fabs(interpolated[k] - value[k]);
}

#endif
#if EOM_SEVERAL
/*
 * x->z, x->k = the first root in the step, and its event; of roots less than `tie` apart, the event of the lowest index.
 * Returns 0 if there is none. Recorded events and those of friction have none if their functions are zero in the whole
 * step, within rounding.
 */
static int eom_first_root(eom_root *x, const eom_run_state *s, eom_event_samples *samples, real tie)
{
#if EOM_RECORDS
    static const real ROUNDING = 64*EOM_EPS; /* of values, relative */
#endif

    x->z = 2;
    for (int k = EOM_NE - 1; k >= 0; k--) {
        real z;

#if EOM_RECORDS
        if ((eom_action[k] == 0 || k >= EOM_OWN_EVENTS) && samples[k].largest <= ROUNDING*s->event[k].largest)
            continue;
#endif
#if EOM_INITIAL_EVENTS
        z = eom_find_root(k, (real)s->event[k].sign, &samples[k]);
#else
        z = eom_find_root((real)s->event[k].sign, &samples[k]);
#endif
        if (z <= x->z + tie) {
            x->z = z;
            x->k = k;
        }
    }
    return x->z <= 1;
}

#endif
/* Compute the state and the event functions at the fraction z, by a shorter step of the method. */
static void eom_evaluate_root(eom_root *x, real z, const eom_run_state *s, const eom_model *m, eom_output *output)
{
#if EOM_ADAPTIVE
    const real of_step = s->part_start + z*s->part_width;

    x->t = s->t0 + of_step*s->size;
    eom_state_in_step(x->q, x->qd, s, of_step, m, output);
#else
    x->t = s->t0 + z*s->size;
    eom_state_in_step(x->q, x->qd, s, z, m, output);
#endif
    x->z = z;
    eom_event_functions(x->value, x->q, x->qd, x->t, m);
}

#if EOM_ADAPTIVE
/* Move a root to the fraction z: if that is nearby in an adaptive step, the state changes as its interpolant does. */
static void eom_move_root(eom_root *x, real z, const eom_run_state *s, const eom_model *m, eom_output *output)
{
    static const real NEARBY = EOM_SHIFT; /* a fraction in which the interpolant deviates by rounding errors */
    const real from = s->part_start + x->z*s->part_width, to = s->part_start + z*s->part_width;
    real q[2][EOM_NQ], qd[2][EOM_NQ];

    if (s->fixed || !(eom_fabs(z - x->z) <= NEARBY)) {
        eom_evaluate_root(x, z, s, m, output);
        return;
    }
    eom_interpolate(q[0], qd[0], s, from);
    eom_interpolate(q[1], qd[1], s, to);
    for (int i = 0; i < EOM_NQ; i++) {
        x->q[i] += q[1][i] - q[0][i];
        x->qd[i] += qd[1][i] - qd[0][i];
    }
    x->z = z;
    x->t = s->t0 + to*s->size;
    eom_event_functions(x->value, x->q, x->qd, x->t, m);
}

#endif
#if EOM_JUMPS
/*
 * Whether the function crosses zero at x, although it is not small there (a discontinuity, or rounding): values over 64
 * times as large follow, and precede it (x->hidden: none do), or the last jump is at most 4 times as far back as the start.
 */
#else
/*
 * Whether the function crosses zero at x, although it is not small there (a discontinuity, or rounding errors): values
 * more than 64 times the residual precede and follow.
 */
#endif
static int eom_accept_root(eom_root *x, real residual, const eom_run_state *s, const eom_event_samples *samples)
{
    const real sign = (real)s->event[x->k].sign, significant = 64*eom_fabs(residual);
    real before = 0, after = 0;

    for (int j = 0; j < EOM_SAMPLES; j++)
        if (eom_nodes[j] < x->z)
            before = eom_greater(sign*samples->g[j], before);
        else
            after = eom_greater(-sign*samples->g[j], after);
#if EOM_JUMPS
    x->hidden = before <= significant;
    return after > significant && (!x->hidden || x->t - s->event[x->k].jump_time <= 4*(x->t - s->t0));
#else
    return after > significant && before > significant;
#endif
}

#if EOM_ADAPTIVE
/*
 * Refine a root with states by shorter steps of the method, which are more accurate than the interpolant, and along the
 * interpolant where the state of an adaptive step moves little: by the secant method, and by bisection if that fails.
 * Returns whether there is a root.
 */
#else
/*
 * Refine a root with states by shorter steps of the method, which are more accurate than the interpolant: by the secant
 * method, and by bisection if that fails. Returns whether there is a root.
 */
#endif
static int eom_refine_root(eom_root *x, const eom_event_samples *samples, const eom_run_state *s, const eom_model *m, eom_output *output)
{
    enum { MAX_SECANTS = 6, MAX_BISECTIONS = 59 };
    static const real NEAR = (real)0.1, AT_ROOT = 100*EOM_CLOSE; /* a fraction; a residual, relative */
    const real sign = (real)s->event[x->k].sign, offset = s->event[x->k].offset;
    real z = x->z, slope = samples->slope, correction = 0, last_value = 0, value;
    real low = samples->from, high = sign*samples->g[EOM_SAMPLES - 1] < 0 ? 1 : samples->high;

    eom_evaluate_root(x, z, s, m, output);
    for (int i = 0;; i++) {
        value = x->value[x->k] - offset;
        if (eom_fabs(correction) > EOM_CLOSE && (value - last_value)/correction*slope > 0)
            slope = (value - last_value)/correction;
        correction = -value/slope;
        if (i == MAX_SECANTS || !(eom_fabs(correction) <= NEAR && eom_fabs(correction) > EOM_EPS))
            break;
        correction = (z + correction < low ? low : z + correction > 1 ? 1 : z + correction) - z;
        z += correction;
        last_value = value;
#if EOM_ADAPTIVE
        eom_move_root(x, z, s, m, output);
#else
        eom_evaluate_root(x, z, s, m, output);
#endif
    }
    for (int i = 0; !(eom_fabs(value) <= AT_ROOT*x->scale); i++) {
        if (i == MAX_BISECTIONS)
            return eom_accept_root(x, value, s, samples);
        z = low + (high - low)/2;
#if EOM_ADAPTIVE
        eom_move_root(x, z, s, m, output);
#else
        eom_evaluate_root(x, z, s, m, output);
#endif
        value = x->value[x->k] - offset;
        if (sign*value > 0)
            low = z;
        else
            high = z;
    }
    return 1;
}

#if !EOM_ONLY_JUMPS
/* Subtract the value of the event function at its root x from later ones, so that the same root is not found again. */
static void eom_set_offset(eom_run_state *s, const eom_root *x, eom_event_samples *samples)
{
    const real value = x->value[x->k], shift = value - s->event[x->k].offset;

    samples->c[0] -= shift;
    for (int j = 0; j < EOM_SAMPLES; j++)
        samples->g[j] -= shift;
    s->event[x->k].offset = value;
}

#endif
#if EOM_ADAPTIVE
/*
 * Detect the events in the part of the last step in the order of time. x->z <= 1: one ends the step, and x = where it
 * stops the run or makes the state jump, or where there are x->limit events.
 */
static eom_status eom_detect_in_part(eom_root *x, eom_event_samples *samples, eom_run_state *s, const eom_model *m, eom_output *output)
#else
#if EOM_ONLY_JUMPS
/* Detect the first event in the last step. x->z <= 1: there is one; x = where the state jumps. */
#else
/*
 * Detect the events in the last step in the order of time. x->z <= 1: one ends the step, and x = where it stops the
 * run or makes the state jump, or where there are EOM_MAX_EVENTS events in the step.
 */
#endif
static eom_status eom_detect_events(eom_root *x, eom_run_state *s, const eom_model *m, eom_output *output)
#endif
{
#if EOM_ADAPTIVE
    const real rounding = 64*EOM_EPS*(1 + eom_fabs(s->t)/(s->part_width*s->size)); /* of a fraction */
#else
    const real rounding = 64*EOM_EPS*(1 + eom_fabs(s->t)/s->size); /* of a fraction */
    eom_event_samples samples[EOM_NE];
#endif
    const real margin = rounding < (real)0.01 ? rounding : (real)0.01;

#if !EOM_ADAPTIVE
#if !EOM_ONLY_JUMPS
    x->limit = output->events + EOM_MAX_EVENTS;
#endif
    output->stopped = eom_sample_events(samples, s, m);
    if (output->stopped)
        return EOM_NOT_FINITE;
#endif
#if EOM_RECORDS
    for (int k = 0; k < EOM_NE; k++)
        s->event[k].largest = eom_greater(samples[k].largest, s->event[k].largest);
#endif
#if EOM_INITIAL_EVENTS
    eom_measure_event_noise(samples, s, m);
#endif
#if EOM_SEVERAL
    for (int n = 0; eom_first_root(x, s, samples, margin); n++) {
#else
    x->k = 0;
#if EOM_JUMPS
    if (samples->is_driven)
        return EOM_ACCUMULATED;
#endif
#if EOM_INITIAL_EVENTS
    for (int n = 0; (x->z = eom_find_root(0, (real)s->event[0].sign, samples)) <= 1; n++) {
#else
    for (int n = 0; (x->z = eom_find_root((real)s->event[0].sign, samples)) <= 1; n++) {
#endif
#endif
        const int k = x->k, wrong_direction = eom_direction[k] == s->event[k].sign;

#if EOM_SEVERAL
#if EOM_JUMPS
        if (samples[k].is_driven)
            return EOM_ACCUMULATED;
#endif
#endif
        x->scale = samples[k].largest + EOM_TINY;
#if EOM_JUMPS
        x->height = eom_greater(eom_fabs(samples[k].g[0]), eom_fabs(eom_evaluate_series(samples[k].c, x->z/2)));
        x->hidden = 0;
#endif
        if (!wrong_direction && !eom_refine_root(x, &samples[k], s, m, output)) {
            samples[k].from = n < EOM_MAX_EVENTS ? x->z + EOM_DIFFERENCE : 1; /* it only touches zero */
            continue;
        }
        s->event[k].sign *= -1;
#if EOM_JUMPS
#if EOM_SEVERAL
        if (!wrong_direction)
            s->event[k].root_time = x->t;
#endif
#endif
        samples[k].from = x->z < 1 - margin ? x->z : 1; /* the remainder is rounding */
        if (wrong_direction)
            continue;
        if (s->t - x->t <= 64*EOM_EPS*eom_fabs(x->t)) /* too short for another step */
            x->t = s->t;
        eom_record_event(output, x);
#if EOM_ONLY_JUMPS
        return EOM_OK;
#else
        eom_set_offset(s, x, &samples[k]);
        if (eom_action[k] == 0 && output->events < x->limit)
            continue;
        output->stopped = eom_action[k] == 1 ? k + 1 : 0;
        return EOM_OK;
#endif
    }
    for (int k = 0; k < EOM_NE; k++)
        if (eom_fabs(samples[k].g[EOM_SAMPLES - 1]) > 100*eom_fabs(s->event[k].offset)) /* the root has been left */
            s->event[k].offset = 0;
    return EOM_OK;
}

#if EOM_ADAPTIVE
/*
 * Detect the events in the last step, as eom_detect_in_part, in parts that resolve the event functions: an adaptive step
 * is halved where it does not. If that does not help, since there is a kink, the remainder of the step is one part.
 */
static eom_status eom_detect_events(eom_root *x, eom_run_state *s, const eom_model *m, eom_output *output)
{
    static const real MIN_WIDTH = (real)0.0009765625; /* 2^-10 */
    int resolves = !s->fixed;
    eom_event_samples samples[EOM_NE];
    eom_status status = EOM_OK;
    real end;

    x->z = 2;
#if !EOM_ONLY_JUMPS
    x->limit = output->events + EOM_MAX_EVENTS;
#endif
    for (s->part_start = 0; !status && x->z > 1 && s->part_start < 1; s->part_start = end) {
        const real rest = 1 - s->part_start, width = resolves && s->part_size > 0 ? 2*s->part_size/s->size : 1;

        s->part_width = width < rest ? width : rest;
        for (;;) {
            output->stopped = eom_sample_events(samples, s, m);
            if (output->stopped)
                return EOM_NOT_FINITE;
            if (!resolves || eom_is_resolved(s, samples, m))
                break;
            resolves = s->part_width > MIN_WIDTH;
            s->part_width = resolves ? s->part_width/2 : rest;
            s->part_size = s->part_width*s->size;
        }
        end = s->part_width < rest ? s->part_start + s->part_width : 1;
        if (s->part_width == width)
            s->part_size = width < 1 ? width*s->size : 0;
        status = eom_detect_in_part(x, samples, s, m, output);
    }
    return status;
}

#endif
#if EOM_INITIAL_EVENTS
/* Whether event functions differ from their values `before`. */
static int eom_have_events_changed(const eom_run_state *s, const real *before, const eom_model *m)
{
    real value[EOM_NE];
    int changes = 0;

    eom_event_functions(value, s->q, s->qd, s->t, m);
    for (int k = 0; k < EOM_NE; k++)
        changes |= value[k] != before[k];
    return changes;
}

#endif
#if EOM_JUMPS
/*
 * Set the signs of event functions that a jump at the root x, or new inputs or parameters (x NULL), have changed from
 * `before`: no event is reported. The value of one that the jump leaves at its root is its new zero level (offset, not 0),
 * by which eom_leaving_sign finds its sign in the next step.
 */
#else
/* Set the signs of event functions that new inputs or parameters have changed from `before`: no event is reported. */
#endif
static void eom_update_signs(eom_run_state *s, const real *before, const eom_root *x, const eom_model *m)
{
#if EOM_SEVERAL
    static const real SAME_TIME = 16*EOM_EPS; /* relative */
#endif
    real value[EOM_NE];

    eom_event_functions(value, s->q, s->qd, s->t, m);
    for (int k = 0; k < EOM_NE; k++) {
        eom_event_state *const e = &s->event[k];
        const real change = eom_fabs(value[k] - before[k]), size = eom_fabs(value[k]) + eom_fabs(before[k]);
#if EOM_JUMPS
#if EOM_SEVERAL
        const int jumps = x && (k == x->k || s->t - e->root_time <= SAME_TIME*eom_fabs(s->t));
        const int has_changed = change > EOM_CLOSE*size && !(x && size <= EOM_CLOSE*x->scale);

        if (jumps && change <= EOM_CLOSE*x->scale) {
#else

        if (x && change <= EOM_CLOSE*x->scale) {
#endif
            e->sign = 0;
            e->offset = value[k] == 0 ? EOM_TINY : value[k];
#if EOM_SEVERAL
        } else if (has_changed) {
#else
        } else if (change > EOM_CLOSE*size) { /* a smaller change leaves the sign as it is */
#endif
#else

        (void)x;
        if (change > EOM_CLOSE*size) { /* a smaller change leaves the sign as it is */
#endif
            e->sign = (value[k] > 0) - (value[k] < 0);
            e->offset = 0;
        }
    }
}
