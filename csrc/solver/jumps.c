/* Jumps of the state at events, their accumulation (Zeno behaviour), and the restart after an event. */

#if EOM_JUMPS
#if EOM_MODES
/* An impact exceeds the friction of bodies that stick: such bodies slide. sticks: which do. */
static void eom_release_sticking(real *after, int *sticks, const real *q)
{
    for (int i = 0; i < EOM_MODES; i++) {
        sticks[i] = q[eom_mode[i][0]] == 0 && after[eom_mode[i][0]] == 0;
        if (sticks[i])
            after[eom_mode[i][0]] = 1;
    }
}

/* Bodies that the projection has moved slide in that direction; others stick again. */
static void eom_set_sliding(real *q, real *qd, const int *sticks, real fastest)
{
    static const real ROUNDING = EOM_CLOSE; /* relative to the fastest velocity */

    for (int i = 0; i < EOM_MODES; i++) {
        real *const side = &q[eom_mode[i][0]], *const speed = &qd[eom_mode[i][1]];

        if (sticks[i] && eom_fabs(*speed) <= ROUNDING*fastest)
            *side = *speed = 0;
        else if ((*side > 0) != (*speed > 0) && *side != 0 && *speed != 0)
            *side = -*side;
    }
}

#endif
#if EOM_CONSTRAINTS
/* Change q and qd by the jump map of event k, and project them onto the constraints. Stops the run if they are not finite. */
#else
/* Change q and qd by the jump map of event k. Stops the run if they are not finite. */
#endif
static eom_status eom_apply_jump(real *q, real *qd, int k, real t, const eom_model *m, eom_output *output)
{
    real maps[EOM_NE*2*EOM_NQ], *const after = maps + 2*EOM_NQ*k;
#if EOM_SETS
    eom_status status = EOM_OK;
#endif
#if EOM_MODES
    int sticks[EOM_MODES] = { 0 };
    real fastest = 0;
#endif

    eom_jump_maps(maps, q, qd, t, m);
    if (!eom_finite(after, 2*EOM_NQ)) {
        output->stopped = k + 1;
        return EOM_NOT_FINITE;
    }
#if EOM_MODES
    if (k < EOM_OWN_EVENTS)
        eom_release_sticking(after, sticks, q);
#endif
    eom_copy_state(q, qd, after, after + EOM_NQ);
#if EOM_MODES
    for (int i = 0; i < EOM_NQ; i++)
        fastest = eom_fabs(qd[i]) > fastest ? eom_fabs(qd[i]) : fastest;
#endif
#if EOM_SETS
    if (k < EOM_OWN_EVENTS && eom_project_state(q, qd, t, eom_jump_sets[k], m)) /* keep the entries that the jump sets, if the constraints permit */
        status = eom_project_state(q, qd, t, 0, m);
#endif
#if EOM_MODES
    if (k < EOM_OWN_EVENTS)
        eom_set_sliding(q, qd, sticks, fastest);
#endif
#if EOM_SETS
    return status;
#else
    return EOM_OK;
#endif
}

/*
 * Update the intervals between jumps of event x->k. Returns whether they accumulate (Zeno behaviour): the intervals after T
 * and T', whose sum is T'^2/(T - T'), are below rounding errors (if T'/T is above 1e-6); or the next height, ratio^2 times
 * this one, is; or no significant value precedes the root (x->hidden); or many jumps coincide.
 */
static int eom_update_accumulation(eom_run_state *s, const eom_root *x, const eom_model *m, eom_output *output)
{
    static const real SAME_TIME = 16*EOM_EPS; /* relative */
    eom_event_state *const e = &s->event[x->k];
    const real t = eom_fabs(x->t), elapsed = x->t - e->jump_time, last = e->interval;
    const real interval = elapsed > SAME_TIME*t ? elapsed : 0, ratio = interval < last ? interval/last : 1;
    const real remaining_time = ratio < 1 ? interval*ratio/(1 - ratio) : 0;
    const int interval_vanishes = ratio > (real)1e-6 && ratio < 1 && (remaining_time <= 4*EOM_EPS*t || interval <= 64*EOM_EPS*t);
    const int is_low = elapsed <= 4*(x->t - s->t0) && ratio*ratio*x->height <= 16*eom_event_rounding(x->k, x->q, x->qd, x->t, m);

#if EOM_SEVERAL
    s->simultaneous_jumps = x->t - s->jumped <= SAME_TIME*t ? s->simultaneous_jumps + 1 : 0;
#else
    s->simultaneous_jumps = interval == 0 ? s->simultaneous_jumps + 1 : 0;
#endif
    e->jump_time = x->t;
#if EOM_SEVERAL
    s->jumped = x->t;
#endif
    if (interval > 0) {
        e->interval = interval;
        s->h = s->h > 2*interval ? 2*interval : s->h;
    }
    output->limit = s->simultaneous_jumps ? x->t : x->t + remaining_time;
#if EOM_MODES
    return s->simultaneous_jumps >= EOM_MAX_SIMULTANEOUS || interval_vanishes || (x->k < EOM_OWN_EVENTS && (x->hidden || is_low));
#else
    return s->simultaneous_jumps >= EOM_MAX_SIMULTANEOUS || interval_vanishes || x->hidden || is_low;
#endif
}

#endif
#if EOM_ONLY_JUMPS
/* The jump at the root x, where the run restarts. */
#else
/* Restart the run at the root x, where an event has stopped it or the state jumps. */
#endif
static eom_status eom_restart(eom_run_state *s, eom_root *x, const eom_model *m, eom_output *output)
{
#if EOM_ONLY_JUMPS
    const int accumulates = eom_update_accumulation(s, x, m, output);
    const eom_status status = eom_apply_jump(x->q, x->qd, x->k, x->t, m, output);

#else
    eom_status status = EOM_OK;
#if EOM_JUMPS
    int accumulates = 0;

    if (eom_action[x->k] == 2) {
        accumulates = eom_update_accumulation(s, x, m, output);
        status = eom_apply_jump(x->q, x->qd, x->k, x->t, m, output);
    }
#else
    (void)output;
#endif
#endif
#if EOM_JUMPS
    s->event[x->k].contact = -s->event[x->k].sign;
#endif
#if EOM_SWITCHES
    for (int i = 0; i < EOM_NQ; i++) /* a coordinate at rest, on which the motion depends, switches a mode */
        if (eom_switch[i] && x->q[i] != s->q[i] && x->qd[i] == 0 && s->qd[i] == 0)
            for (int k = 0; k < EOM_NE; k++)
                s->event[k].contact = 0;
#endif
    eom_copy_state(s->q, s->qd, x->q, x->qd);
    s->t = x->t;
    s->size = 0;
#if EOM_ADAPTIVE
    for (int i = 0; i < EOM_NQ; i++)
        s->q_rest[i] = s->qd_rest[i] = 0;
    s->t_rest = s->ideal = 0;
    s->steps_since_restart = 0;
#endif
#if EOM_ONLY_JUMPS
    eom_update_signs(s, x->value, x, m);
#else
#if EOM_JUMPS
    if (eom_action[x->k] == 2)
        eom_update_signs(s, x->value, x, m);
#else
    (void)m;
#endif
#endif
#if EOM_JUMPS
    return !status && accumulates ? EOM_ACCUMULATED : status;
#else
    return status;
#endif
}

#if EOM_INITIAL_EVENTS
/* The jumps of events that trigger at the start of a motion: of a run, or after a jump. */
static eom_status eom_apply_initial_events(eom_run_state *s, const eom_model *m, eom_output *output)
{
    eom_status status = EOM_OK;

    while (!status) {
        eom_root x;
        int k = 0;

        eom_initial_event_functions(x.value, s->q, s->qd, s->t, m);
        while (k < EOM_NE && !(x.value[k] > 0))
            k++;
        if (k == EOM_NE)
            break;
        x.k = k;
        x.z = 0;
        x.t = s->t;
        x.scale = x.value[k];
        x.height = 0;
        x.hidden = 0;
        eom_copy_state(x.q, x.qd, s->q, s->qd);
        eom_event_functions(x.value, x.q, x.qd, s->t, m);
        eom_record_event(output, &x);
        status = eom_restart(s, &x, m, output);
    }
    return status;
}

#endif
