/* Steps of fixed size between which events are detected. */

#if !EOM_ADAPTIVE
/* q, qd = the state at the fraction z of the last step, from the interpolant. */
static void eom_interpolate(real *q, real *qd, const eom_run_state *s, real z)
{
    for (int k = 0; k < EOM_NQ; k++) {
        const real *const c = s->powers[k];

        q[k] = s->q0[k] + z*(s->size*s->qd0[k] + z*(c[0] + z*(c[1] + z*(c[2] + z*c[3]))));
        qd[k] = s->qd0[k] + z*(2*c[0] + z*(3*c[1] + z*(4*c[2] + z*5*c[3])))/s->size;
    }
}

#endif
/*
 * The end of the next step: the next time s->grid_start + n h, or t_end; after a jump s->h ahead at most, twice the
 * interval between jumps. If h changes, the grid restarts here.
 */
static real eom_next_grid_time(eom_run_state *s, real t_end, real h)
{
    real near, end;

    if (s->grid_step != h) {
        s->grid_step = h;
        s->grid_start = s->t;
    }
    near = 64*EOM_EPS*(eom_fabs(s->t) + eom_fabs(s->grid_start));
    near = near < h/4 ? near : h/4;
    end = s->grid_start + (1 + eom_floor((s->t - s->grid_start + near)/h))*h;
    end = end < t_end - near ? end : t_end;
#if EOM_JUMPS
    if (!(s->size > 0) && s->h > 0 && end - s->t > s->h) /* directly after a jump */
        end = s->t + (s->h > near ? s->h : near);
#endif
    return end;
}

/*
 * Store the interpolant of a step of size h from s->q, s->qd to q, qd, of degree five (Hermite). It matches positions,
 * velocities and accelerations (before, after) at both ends. Accelerations: even + odd x + second (x^2 - 1)
 * + cubic (x^3 - x), x = 2 z - 1; cubic = 0 if it is rounding. mean, weighted_mean: means over 0 <= z <= 1 of the
 * accelerations, and of 1 - z times them.
 */
static void eom_fit_interpolant(eom_run_state *s, const real *q, const real *qd, const real *before, const real *after, real h)
{
    for (int k = 0; k < EOM_NQ; k++) {
        const real mean = (qd[k] - s->qd[k])/h, weighted_mean = ((q[k] - s->q[k])/h - s->qd[k])/h;
        const real even = (before[k] + after[k])/2, odd = (after[k] - before[k])/2;
        const real third = (real)2.5*odd - (real)7.5*(mean - 2*weighted_mean), second = (real)1.5*(even - mean);
        const real cubic = eom_fabs(third)*h*h > 64*EOM_EPS*eom_fabs(q[k]) ? third : 0;
        real *const power = s->powers[k];

#if EOM_ADAPTIVE
        for (int i = 4; i < EOM_POWERS; i++)
            power[i] = 0;
        power[0] = even - second;
        power[1] = odd - cubic;
        power[2] = second;
        power[3] = cubic;
#else
        power[0] = h*h*before[k]/2;
        power[1] = h*h*(odd - 2*second + 2*cubic)/3;
        power[2] = h*h*(second - 3*cubic)/3;
        power[3] = h*h*cubic*2/5;
#endif
    }
}

#if EOM_INITIAL_EVENTS
/* The end of the last step by Simpson's rule: a joint that friction holds has rounding errors as velocity. */
static eom_status eom_integrate_accelerations(eom_run_state *s, const real *before, const real *after, const eom_model *m)
{
    const real h = s->size;
    real q[EOM_WIDTH] = { 0 }, qd[EOM_WIDTH] = { 0 }, halfway[EOM_WIDTH] = { 0 };

    eom_interpolate(q, qd, s, (real)0.5);
    if (eom_accelerate(halfway, q, qd, s->t0 + h/2, m))
        return EOM_SINGULAR;
    for (int k = 0; k < EOM_NQ; k++) {
        s->by_q[k] = s->q0[k] + h*(s->qd0[k] + h*(before[k] + 2*halfway[k])/6);
        s->by_qd[k] = s->qd0[k] + h*(before[k] + 4*halfway[k] + after[k])/6;
    }
    return EOM_OK;
}

#endif
/* The next step: to the next multiple of the size `step`, or to t_end. */
static eom_status eom_step_on_grid(eom_run_state *s, real t_end, real step, const eom_model *m, eom_output *output)
{
    real q[EOM_WIDTH] = { 0 }, qd[EOM_WIDTH] = { 0 }, before[EOM_WIDTH], after[EOM_WIDTH], end, h;
    eom_status status;

    end = eom_next_grid_time(s, t_end, step);
    h = eom_fabs(end - s->t - step) <= 2*EOM_EPS*eom_fabs(end) ? step : end - s->t;
    eom_copy_state(q, qd, s->q, s->qd);
    output->evaluations++;
#if EOM_METHODS
    status = eom_call_step(s->method, q, qd, s->t, h, m);
#else
    status = eom_call_step(q, qd, s->t, h, m);
#endif
    if (status)
        return status;
    if (eom_accelerate(before, s->q, s->qd, s->t, m) || eom_accelerate(after, q, qd, s->t + h, m))
        return EOM_SINGULAR;
    eom_fit_interpolant(s, q, qd, before, after, h);
    eom_copy_state(s->q0, s->qd0, s->q, s->qd);
    eom_copy_state(s->q, s->qd, q, qd);
    s->t0 = s->t;
    s->size = h;
    s->h = step; /* the next jump is not expected soon */
    s->t = end;
    output->steps++;
#if EOM_ADAPTIVE
    for (int k = 0; k < EOM_NQ; k++)
        s->q_rest[k] = s->qd_rest[k] = 0;
    s->t_rest = s->t0_rest = s->ideal = 0;
    s->steps_since_restart = s->used_newton = 0;
#endif
#if EOM_INITIAL_EVENTS
    return eom_integrate_accelerations(s, before, after, m);
#else
    return EOM_OK;
#endif
}

/* q, qd = the state at the fraction z of the last step, by a shorter step of the same method. */
static void eom_state_in_step(real *q, real *qd, const eom_run_state *s, real z, const eom_model *m, eom_output *output)
{
#if EOM_ADAPTIVE
    if (!s->fixed) {
        eom_state_within(q, qd, s, z, s->tol, m, output);
        return;
    }
#endif
    eom_copy_state(q, qd, s->q0, s->qd0);
    output->evaluations++;
#if EOM_METHODS
    if (eom_call_step(s->method, q, qd, s->t0, z*s->size, m))
#else
    if (eom_call_step(q, qd, s->t0, z*s->size, m))
#endif
        eom_interpolate(q, qd, s, z); /* that step failed */
}
