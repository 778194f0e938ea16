/*
 * Tests of any method with fixed steps. Included after the function advance, which makes one step. ORDER: the order
 * of convergence of the method. DAMPED: whether it has that order for forces that depend on velocities.
 */

/* The state after n steps from t = 0 to the given time; returns the largest change of it since the last call. */
static real integrate(real *x, int n, real duration, const eom_model *m)
{
    real q[2] = { 1, (real)-0.5 }, qd[2] = { (real)0.25, 1 }, largest = 0;

    for (int i = 0; i < n; i++)
        CHECK(advance(q, qd, duration*(real)i/(real)n, duration/(real)n, m) == EOM_OK, i);
    for (int k = 0; k < 2; k++) {
        largest = eom_fmax(largest, eom_fmax(eom_fabs(q[k] - x[k]), eom_fabs(qd[k] - x[2 + k])));
        x[k] = q[k];
        x[2 + k] = qd[k];
    }
    return largest;
}

/*
 * Halving the step divides the error by 2^ORDER, as long as it is larger than rounding errors. Of order 16, only the
 * errors of a linear system are large enough in steps that are short enough.
 */
static void test_order(void)
{
    const model_kind kind = ORDER > 8 ? OSCILLATOR : COUPLED;
    const eom_model m = { .kind = kind, .k = 1, .c = DAMPED ? (real)0.25 : 0 };
    const real duration = ORDER > 8 ? 4 : 1;
    real x[4] = { 0 }, last = 0, order = 0;

    integrate(x, 1, duration, &m);
    for (int n = 2; n <= 512; n *= 2) {
        const real change = integrate(x, n, duration, &m);

        if (n > 2 && change > 100*EOM_EPS)
            order = (real)(log(last/change)/log(2));
        last = change;
    }
#ifdef SINGLE
    if (ORDER > 4) /* of higher order, single precision has only rounding errors */
        return;
#endif
    CHECK(order > ORDER - (real)0.3, order);
    CHECK(order < ORDER + (real)0.5, order);
}

/* A method of order p integrates accelerations t^n exactly for n < p; the position for n < p - 1. */
static void test_polynomials(void)
{
    for (int degree = 0; degree <= ORDER; degree++) {
        const eom_model m = { .kind = POLYNOMIAL, .degree = degree };
        real q[2] = { 0 }, qd[2] = { 0 };
        const real h = 1, exact = 1/(real)(degree + 2);

        CHECK(advance(q, qd, 0, h, &m) == EOM_OK, degree);
        if (degree < ORDER)
            CHECK(eom_fabs(qd[1] - 1) <= 32*EOM_EPS, qd[1] - 1);
        if (degree < ORDER - 1)
            CHECK(eom_fabs(q[1] - exact) <= 32*EOM_EPS, q[1] - exact);
#ifndef SINGLE
        if (degree == ORDER)
            CHECK(eom_fabs(qd[1] - 1) > 1000*EOM_EPS, qd[1] - 1);
#endif
    }
}

/* A step that fails leaves the state unchanged. */
static void test_failed_steps(void)
{
    const eom_model lost = { .kind = PENDULUM, .reach = (real)0.01 }, undefined = { .kind = OSCILLATOR, .k = (real)INFINITY };
    real q[2] = { 2, 0 }, qd[2] = { 0, 1 };

    CHECK(advance(q, qd, 0, (real)0.1, &lost) == EOM_SINGULAR, 0);
    CHECK(advance(q, qd, 0, (real)0.1, &undefined) == EOM_NOT_FINITE, 0);
    CHECK(q[0] == 2 && q[1] == 0 && qd[0] == 0 && qd[1] == 1, q[0]);
}

static void test_steps(void)
{
    test_order();
    test_polynomials();
    test_failed_steps();
}
