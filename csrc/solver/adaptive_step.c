/* One accepted step of adaptive size, and the state within it. */

/* Add the increment to a number by compensated summation (Kahan, Commun. ACM 8 (1965), 40). */
static void eom_add_compensated(real *sum, real *rest, real increment)
{
    const real to = *sum + (increment + *rest);

    *rest = (*sum - to) + (increment + *rest);
    *sum = to;
}

/* Begin attempts at a step: the accelerations at its start, its size, and the method of iteration. */
static eom_status eom_begin_attempts(eom_attempt *a, eom_run_state *s, real t_end, real max_step, const eom_model *m, eom_output *output)
{
#if EOM_KINKS
    const int starts = 1;
#else
    const int starts = !(s->size > 0);
#endif

    if (starts) {
        output->evaluations++;
        if (eom_accelerate(a->f, s->q, s->qd, s->t, m))
            return EOM_SINGULAR;
        if (!(s->h > 0))
            eom_initial_step_size(s, a->f, t_end);
    }
#if EOM_KINKS
    a->starts_constant = !(s->size > 0) || s->kink;
    a->least = eom_least_step_size(s);
    a->kink_error = 0;
#endif
    if (max_step > 0 && s->h > max_step)
        s->h = max_step;
    a->h = a->planned = s->h;
    a->rejected = a->newton_failures = 0;
#if EOM_CONSTRAINTS
    a->x.project = 0;
#endif
#if EOM_REST
    a->x.capped = a->measured = 0;
#endif
    a->x.newton = s->newton_steps > 0;
    if (a->x.newton)
        eom_begin_newton(&a->x, s->q, s->qd, s->t, a->h, m, output);
    return EOM_OK;
}

/*
 * a->factor = the admissible size, relative to that of the attempt. The size is chosen such that the roughness of
 * the step is `aim`, sqrt(tol/2): the error of its end is the square of that of the polynomial (as Rein & Spiegel,
 * MNRAS 446 (2015), 1424).
 */
static void eom_assess_error(eom_attempt *a, const eom_run_state *s, real tol, real aim)
{
    static const real LEAST_ERROR = (real)1e-8; /* avoids a division by zero */
#if EOM_KINKS
    (void)s;
#else
    static const real SAFETY = (real)0.95;
    static const real LEAST_SIZE = (real)1e-6; /* relative to t and the span: errors of shorter steps are rounding errors */
#endif

    a->factor = a->x.rough > LEAST_ERROR*aim ? eom_sqrt(eom_sqrt(eom_sqrt(aim/a->x.rough))) : eom_max_factor;
    if (a->x.newton && a->outcome == EOM_CONVERGED) { /* in stiff motion the error of the end is that of the polynomial, not its square */
        const real left = a->x.beyond/((EOM_GAUSS_STAGES + 1)*tol);
        const real stiff = eom_sqrt(eom_sqrt(eom_sqrt(1/(left > LEAST_ERROR ? left : LEAST_ERROR))));

        a->factor = stiff < a->factor ? stiff : a->factor;
    }
#if !EOM_KINKS
    if (!a->x.newton && a->outcome == EOM_CONVERGED && a->factor >= eom_accepted_factor && a->h > LEAST_SIZE*(eom_fabs(s->t) + s->span)) {
#if EOM_CONSTRAINTS
        const real rounding = a->x.project ? 16*EOM_SQRT_EPS : 0, left = a->x.beyond/(tol > rounding ? tol : rounding);
#else
        const real left = a->x.beyond/tol;
#endif

        if (left > 1) /* also at steep forces, where the coefficients hardly decrease */
            a->factor = left > 4 ? SAFETY/eom_sqrt(left) : (real)0.5;
    }
#endif
}

/* Solve an attempt and estimate its error. */
static void eom_try_step(eom_attempt *a, const eom_run_state *s, real t_end, real tol, const eom_model *m, eom_output *output)
{
    enum { S = EOM_GAUSS_STAGES };
    const real aim = eom_sqrt(tol/2);
#if EOM_KINKS
    const int constant = a->starts_constant;
#else
    const int constant = !(s->size > 0);
#endif

    a->ends = !(a->h < t_end - s->t - s->t_rest);
    if (a->ends)
        a->h = t_end - s->t - s->t_rest;
    for (int k = 0; constant && k < EOM_NQ; k++)
        for (int i = 0; i < S; i++)
            a->x.a.x[k][i] = a->f[k];
    if (!constant)
        eom_predict_stages(&a->x.a, s, 1, a->h/s->size);
    if (a->x.newton)
        eom_factor_newton(&a->x.newton_data, a->h);
    a->outcome = eom_solve_stages(&a->x, s->q, s->qd, s->t, a->h, tol, EOM_MAX_ROUGHNESS*aim, m);
    output->evaluations += S*(a->x.sweeps > EOM_MAX_SWEEPS ? EOM_MAX_SWEEPS : a->x.sweeps);
    eom_assess_error(a, s, tol, aim);
#if EOM_KINKS
    if (a->outcome == EOM_CONVERGED && a->factor >= eom_accepted_factor)
        eom_assess_kink(a, s, tol, m, output);
#endif
}

#if EOM_REST
/* Measure rounding errors of the accelerations, once. Returns whether the attempt is repeated with capped scales. */
static int eom_measure_rest(eom_attempt *a, const eom_run_state *s, real tol, const eom_model *m, eom_output *output)
{
    static const real FLAT = (real)0.05; /* ratio of the last squared coefficients to those before, above which they hardly decrease */
    real flat;
#if EOM_KINKS
    const real KINK = (real)0.3; /* error relative to its bound above which a step has a kink */
    real smooth;
#endif

    if (a->measured || a->outcome == EOM_UNDEFINED)
        return 0;
    (void)eom_roughness(&a->x.a, a->x.scale, a->x.coarse, FLAT, &flat);
#if EOM_KINKS
    if (!(a->kink_error > KINK || (flat > 0 && (a->outcome == EOM_NOT_CONVERGED || a->factor < 2))))
        return 0;
#else
    if (!(flat > 0 && (a->outcome == EOM_NOT_CONVERGED || a->factor < 2)))
        return 0;
#endif
    a->measured = 1;
    output->evaluations += 2*EOM_GAUSS_STAGES;
    eom_cap_scales(&a->x, s->q, s->qd, s->t, a->h, tol, m);
#if EOM_KINKS
    a->x.capped |= a->kink_error > KINK && eom_kink_error(&a->x.a, s, a->f, a->end_f, a->h, a->x.cap, &smooth)/eom_kink_tolerance(tol) < a->kink_error/2;
#endif
    return a->x.capped;
}

#endif
/* Change the method of iteration after a rejected attempt. Returns whether the attempt is repeated with its size. */
static int eom_change_iteration(eom_attempt *a, eom_run_state *s, const eom_model *m, eom_output *output)
{
    enum { MAX_FAILURES = 2 }; /* of Newton's method in a step */
    const int failed = a->outcome == EOM_UNDEFINED || (a->outcome == EOM_NOT_CONVERGED && a->factor > 1);

#if EOM_CONSTRAINTS
    if (!a->x.project && !a->x.newton && failed && (a->rejected || s->stiff_votes > 0)) { /* for example near a singular position */
        a->x.project = 1;
        a->h = a->planned;
        return 1;
    }
#endif
    if (a->x.newton && failed && ++a->newton_failures > MAX_FAILURES) /* Newton's method does not help here */
        a->x.newton = s->newton_steps = s->stiff_votes = 0;
    else if (!a->x.newton && a->outcome == EOM_NOT_CONVERGED && a->factor > 1)
        s->stiff_votes += 2;
    if (a->outcome != EOM_CONVERGED && s->stiff_votes > EOM_STIFF_VOTES && !a->x.newton) {
        eom_begin_newton(&a->x, s->q, s->qd, s->t, a->h, m, output);
        s->newton_steps = EOM_NEWTON_STEPS;
        return a->x.newton;
    }
    return 0;
}

/* Reduce the size of an attempt, or return why no step can be made from this state. */
static eom_status eom_reduce_size(eom_attempt *a, const eom_run_state *s, const eom_model *m)
{
    /* size of the next attempt: if a stage has no acceleration; if the iteration diverges; at least; if nearly accepted */
    static const real UNDEFINED_FACTOR = (real)0.25, DIVERGED_FACTOR = (real)0.6, LEAST_FACTOR = (real)0.1, CLOSE_FACTOR = (real)0.84;
    static const real SAFETY = (real)0.95;

#if EOM_KINKS
    if (a->h <= a->least) {
#else
    if (a->h <= eom_least_step_size(s)) {
#endif
        if (a->outcome != EOM_UNDEFINED)
            return EOM_NO_CONVERGENCE;
        return eom_accelerate(a->f, s->q, s->qd, s->t, m) ? EOM_SINGULAR : EOM_NOT_FINITE;
    }
    a->rejected = 1;
#if EOM_CONSTRAINTS
    a->x.project += a->x.project > 0;
#endif
#if EOM_REST
    a->measured = a->x.capped = 0;
#endif
    if (a->outcome == EOM_UNDEFINED)
        a->factor = UNDEFINED_FACTOR;
    else if (a->factor > DIVERGED_FACTOR && a->outcome == EOM_NOT_CONVERGED)
        a->factor = DIVERGED_FACTOR;
    a->h *= a->factor < LEAST_FACTOR ? LEAST_FACTOR : a->factor > CLOSE_FACTOR ? eom_accepted_factor : SAFETY*a->factor;
    return EOM_OK;
}

/* Try steps, ever shorter, until one is accepted. */
static eom_status eom_find_step(eom_attempt *a, eom_run_state *s, real t_end, real tol, const eom_model *m, eom_output *output)
{
    for (;;) {
        eom_status status;

        eom_try_step(a, s, t_end, tol, m, output);
#if EOM_REST
        if (eom_measure_rest(a, s, tol, m, output))
            continue;
#endif
        if (a->outcome == EOM_CONVERGED && a->factor >= eom_accepted_factor)
            return EOM_OK;
#if EOM_KINKS
        if (a->outcome != EOM_UNDEFINED && a->h <= a->least && eom_skip_kink(s, a->least)) {
            a->kink_error = 1;
            a->factor = eom_max_factor;
            return EOM_OK;
        }
#endif
        output->rejected++;
        if (eom_change_iteration(a, s, m, output))
            continue;
        status = eom_reduce_size(a, s, m);
        if (status)
            return status;
    }
}

/* Advance the state and the time by a step of size h with the increments r and v. Returns NOT_FINITE if that is not finite. */
static eom_status eom_advance_state(eom_run_state *s, const real *r, const real *v, const eom_attempt *a, real t_end)
{
    enum { NQ = EOM_NQ };

    for (int k = 0; k < NQ; k++) {
        const real to = s->q[k] + r[k], going = s->qd[k] + v[k];

        if (!(to - to == 0) || !(going - going == 0))
            return EOM_NOT_FINITE;
    }
    for (int k = 0; k < NQ; k++) {
        s->q0[k] = s->q[k];
        s->qd0[k] = s->qd[k];
#if EOM_KINKS
        s->max_q[k] = eom_fabs(s->q[k]) > s->max_q[k] ? eom_fabs(s->q[k]) : s->max_q[k];
        s->max_qd[k] = eom_fabs(s->qd[k]) > s->max_qd[k] ? eom_fabs(s->qd[k]) : s->max_qd[k];
#endif
        eom_add_compensated(&s->q[k], &s->q_rest[k], r[k]);
        eom_add_compensated(&s->qd[k], &s->qd_rest[k], v[k]);
    }
    s->t0 = s->t;
    s->t0_rest = s->t_rest;
    s->size = a->h;
    if (a->ends) {
        s->t = t_end;
        s->t_rest = 0;
    } else {
        eom_add_compensated(&s->t, &s->t_rest, a->h);
    }
    return EOM_OK;
}

/* The next step, to t_end at most. */
static eom_status eom_adaptive_step(eom_run_state *s, real t_end, real tol, real max_step, const eom_model *m, eom_output *output)
{
    real r[EOM_WIDTH] = { 0 }, v[EOM_WIDTH] = { 0 }, middle, ideal;
    eom_attempt a;
    eom_status status = eom_begin_attempts(&a, s, t_end, max_step, m, output);

    if (!status)
        status = eom_find_step(&a, s, t_end, tol, m, output);
    if (status)
        return status;
    if (!a.ends && 16*a.h <= EOM_EPS*eom_fabs(s->t)) /* the sizes decrease towards a singularity */
        return EOM_NO_CONVERGENCE;
    eom_step_increments(r, v, &a.x.a, s->qd, a.h);
    eom_store_interpolant(s, &a.x.a);
#if EOM_CONSTRAINTS
    {
        int singular = 0;

        status = eom_project_increments(r, v, s->q, s->qd, s->t + a.h, m, &singular);
        if (status)
            return status;
        if (singular && output->singular++ == 0)
            output->first = s->t + a.h;
        s->used_projection = a.x.project > 0;
    }
#endif
    middle = s->t + a.h/2;
    if (eom_advance_state(s, r, v, &a, t_end))
        return EOM_NOT_FINITE;
    output->steps++;
    ideal = a.h*(a.factor > eom_max_factor ? eom_max_factor : a.factor);
    eom_choose_next_size(s, &a, ideal, middle);
    eom_update_stiffness(s, &a, ideal, output);
#if EOM_KINKS
    if (!eom_makes_progress(s, &a))
        return EOM_NO_CONVERGENCE;
#endif
    s->ideal = ideal;
    s->ideal_time = middle;
    s->steps_since_restart += s->steps_since_restart < 2;
    return EOM_OK;
}

/*
 * q, qd = the state at the fraction z of the last step, as accurate as a step: by a shorter step, whose iteration
 * starts from the interpolant.
 */
static void eom_state_within(real *q, real *qd, const eom_run_state *s, real z, real tol, const eom_model *m, eom_output *output)
{
    const real h = z*s->size;
    eom_solution x;

    x.newton = s->used_newton;
#if EOM_CONSTRAINTS
    x.project = s->used_projection;
#endif
#if EOM_REST
    x.capped = 0;
#endif
    if (x.newton)
        eom_begin_newton(&x, s->q0, s->qd0, s->t0, h, m, output);
    if (x.newton)
        eom_factor_newton(&x.newton_data, h);
    eom_predict_stages(&x.a, s, 0, z);
#if EOM_CONSTRAINTS
    if (eom_solve_stages(&x, s->q0, s->qd0, s->t0, h, tol, EOM_HUGE, m) != EOM_CONVERGED)
        eom_predict_stages(&x.a, s, 0, z); /* a stage is too near a singular position: use the interpolant alone */
#else
    (void)eom_solve_stages(&x, s->q0, s->qd0, s->t0, h, tol, EOM_HUGE, m);
#endif
    output->evaluations += EOM_GAUSS_STAGES*(x.sweeps > EOM_MAX_SWEEPS ? EOM_MAX_SWEEPS : x.sweeps);
    eom_step_end(q, qd, &x.a, s->q0, s->qd0, h);
}
