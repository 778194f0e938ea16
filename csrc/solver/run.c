/* Runs: the loop over steps, the stored rows, and the continuation of a run in the next call. */

/* Store a state and its time in the next row, unless the times of rows are given. */
static void eom_store_step(eom_output *output, const eom_options *options, real t, const real *q, const real *qd)
{
    if (options->times || output->rows >= options->rows)
        return;
    output->t_rows[output->rows] = t;
    eom_copy_state(output->q_rows + EOM_NQ*output->rows, output->qd_rows + EOM_NQ*output->rows, q, qd);
    output->rows++;
}

/* Store the states at the given times up to t, within the last step. */
static void eom_store_times(eom_output *output, const eom_options *options, const eom_run_state *s, real t, const eom_model *m)
{
    while (options->times && output->rows < options->rows && options->times[output->rows] <= t) {
        const real time = options->times[output->rows];
        real *const q = output->q_rows + EOM_NQ*output->rows, *const qd = output->qd_rows + EOM_NQ*output->rows;
#if EOM_ADAPTIVE
        const int at_end = time == s->t && s->t_rest == 0;
        const real z = at_end ? 1 : (time - s->t0 - s->t0_rest)/s->size;
#else
        const int at_end = time == s->t;
#endif

        output->rows++;
        if (at_end)
            eom_copy_state(q, qd, s->q, s->qd);
        else
#if EOM_EVENTS
#if EOM_ADAPTIVE
            eom_state_in_step(q, qd, s, z, m, output);
#else
            eom_state_in_step(q, qd, s, (time - s->t0)/s->size, m, output);
#endif
#else
            eom_state_within(q, qd, s, z, s->tol, m, output);
#endif
#if EOM_CONSTRAINTS
        if (!at_end)
            (void)eom_project_state(q, qd, time, 0, m);
#endif
    }
}

/* Begin a run at q, qd, or continue that in memory if it has this state exactly (returns 1). */
static int eom_begin_run(eom_run_state *s, const real *q, const real *qd, const eom_options *options, const eom_model *m, eom_output *output)
{
    const real t = output->has_started ? output->t : options->t0;
#if EOM_JUMPS
    const int has_jumped = output->limit != 0 && t <= output->limit; /* in the previous call */
#endif
    int warm = output->has_started && output->memory && output->memory->warm;

    if (warm) {
        memcpy(s, output->memory->data, sizeof *s);
        warm = s->t == t;
        for (int i = 0; warm && i < EOM_NQ; i++)
            warm = s->q[i] == q[i] && s->qd[i] == qd[i];
    }
    if (!warm) {
        memset(s, 0, sizeof *s);
#if EOM_EVENTS
        output->stopped = 0;
#if EOM_JUMPS
#if EOM_SEVERAL
        s->jumped = t;
        for (int k = 0; k < EOM_NE; k++)
            s->event[k].root_time = -EOM_HUGE;
#endif
        for (int k = 0; k < EOM_NE; k++) {
            s->event[k].jump_time = t;
#if EOM_TWO_SIDED
            s->event[k].contact = has_jumped ? output->contact[k] : 0;
#else
            s->event[k].contact = has_jumped ? -eom_direction[k] : 0;
#endif
        }
#endif
#endif
        eom_copy_state(s->q, s->qd, q, qd);
        s->t = t;
#if EOM_ADAPTIVE
        s->newton_steps = options->stiff ? EOM_NEWTON_STEPS : 0;
        s->stiff_votes = options->stiff ? EOM_MAX_VOTES : 0;
#endif
    }
#if EOM_ADAPTIVE
    s->tol = options->tol < EOM_LOOSEST ? options->tol > EOM_TIGHTEST ? options->tol : EOM_TIGHTEST : EOM_LOOSEST;
#endif
#if EOM_EVENTS
#if EOM_ADAPTIVE
    s->fixed = options->h != 0;
#endif
#if EOM_METHODS
    s->method = options->method;
#endif
#endif
    if (!output->has_started) {
        output->has_started = 1;
        eom_store_step(output, options, s->t, q, qd);
        eom_store_times(output, options, s, s->t, m);
    }
    return warm;
}

#if EOM_EVENTS
/* Make the next step, detect its events, store its rows, and jump or stop where an event does. */
static eom_status eom_step_with_events(eom_run_state *s, const eom_options *options, const eom_model *m, eom_output *output)
{
    eom_root x;
#if EOM_ADAPTIVE
    eom_status status = s->fixed ? eom_step_on_grid(s, options->t_end, options->h, m, output) : eom_adaptive_step(s, options->t_end, s->tol, options->max_step, m, output);
#else
    eom_status status = eom_step_on_grid(s, options->t_end, options->h, m, output);
#endif

    if (status)
        return status;
    status = eom_detect_events(&x, s, m, output);
    if (status) { /* discard the step: its start is the last valid state */
        eom_copy_state(s->q, s->qd, s->q0, s->qd0);
        s->t = s->t0;
        s->size = 0;
        return status;
    }
    eom_store_times(output, options, s, x.z <= 1 ? x.t : s->t, m);
    if (x.z <= 1) {
#if EOM_ONLY_JUMPS
        eom_store_step(output, options, x.t, x.q, x.qd);
#else
        if (!output->stopped)
            eom_store_step(output, options, x.t, x.q, x.qd);
#endif
        status = eom_restart(s, &x, m, output);
#if EOM_INITIAL_EVENTS
        if (!status)
            status = eom_apply_initial_events(s, m, output);
#endif
#if EOM_CONSTRAINTS
        if (!status)
            status = eom_project_state(s->q, s->qd, s->t, 0, m);
#endif
    }
    if (status != EOM_NOT_FINITE)
        eom_store_step(output, options, s->t, s->q, s->qd);
    return status;
}

#endif
/* Integrate q, qd in place to options->t_end, by options->steps steps at most. */
static eom_status eom_run(real *q, real *qd, const eom_options *options, const eom_model *m, eom_output *output)
{
    enum { FITS = 1/(sizeof(eom_run_state) <= sizeof output->memory->data) }; /* else an error */
    eom_run_state s;
    const int continues = eom_begin_run(&s, q, qd, options, m, output);
    const int is_finite = eom_finite(&s.t, 1) && options->t_end == options->t_end;
    eom_status status = is_finite ? EOM_OK : EOM_NOT_FINITE;
#if EOM_INITIAL_EVENTS
    const int applies = !continues || eom_have_events_changed(&s, s.last_values, m);
#endif

#if !EOM_EVENTS
    (void)continues;
#endif
#if EOM_EVENTS
    if (continues)
        eom_update_signs(&s, s.last_values, 0, m);
#if EOM_INITIAL_EVENTS
    if (!status && applies)
        status = eom_apply_initial_events(&s, m, output);
#endif
#endif
    for (long n = 0; !status && n < options->steps && s.t < options->t_end; n++) {
#if EOM_EVENTS
        if (output->stopped || (output->which && output->events + EOM_MAX_EVENTS > output->room))
            break;
#endif
#if EOM_EVENTS
        if (options->max_evaluations && output->evaluations >= options->max_evaluations)
            status = EOM_TOO_LONG;
        else
            status = eom_step_with_events(&s, options, m, output);
#else
        if (options->max_evaluations && output->evaluations >= options->max_evaluations) {
            status = EOM_TOO_LONG;
            break;
        }
        status = eom_adaptive_step(&s, options->t_end, s.tol, options->max_step, m, output);
        if (status)
            break;
        eom_store_times(output, options, &s, s.t, m);
        eom_store_step(output, options, s.t, s.q, s.qd);
#endif
    }
    eom_copy_state(q, qd, s.q, s.qd);
    output->t = s.t;
#if EOM_TWO_SIDED
    for (int k = 0; k < EOM_NE; k++)
        output->contact[k] = s.event[k].contact;
#endif
#if EOM_EVENTS
    eom_event_functions(s.last_values, s.q, s.qd, s.t, m);
#endif
    if (output->memory) {
        memcpy(output->memory->data, &s, sizeof s);
        output->memory->warm = 1;
    }
    return status;
}
