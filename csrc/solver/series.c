/* Chebyshev series of a function over an interval: sum c[n] T_n(1 - 2 x), where x is the fraction of the interval. */

/* The shifted Chebyshev series sum c[n] T_n(1 - 2x), 0 <= x <= 1, by Clenshaw's recurrence. */
static real eom_evaluate_series(const real *c, real x)
{
    const real twice = 2*(1 - 2*x);
    real sum = 0, last = 0;

    for (int n = EOM_SAMPLES - 1; n > 0; n--) {
        const real next = c[n] + twice*sum - last;

        last = sum;
        sum = next;
    }
    return c[0] + twice/2*sum - last;
}

/* c = the series with values g at the nodes: a cosine transform, in which end terms count half. */
static void eom_fit_series(real *c, const real *g)
{
    const real last = g[EOM_SAMPLES - 1];

    for (int n = 0; n < EOM_SAMPLES; n++)
        c[n] = (2*eom_evaluate_series(g, eom_nodes[n]) - g[0] - (n % 2 ? -last : last))/(EOM_SAMPLES - 1);
    c[0] /= 2;
    c[EOM_SAMPLES - 1] /= 2;
}

/* d = the derivative of a series by x. */
static void eom_differentiate_series(real *d, const real *c)
{
    d[EOM_SAMPLES - 1] = 0;
    for (int n = EOM_SAMPLES - 1; n > 0; n--)
        d[n - 1] = (n < EOM_SAMPLES - 1 ? d[n + 1] : 0) - (real)(4*n)*c[n];
    d[0] /= 2;
}

/*
 * The zero of a series between low, where it has this sign or is zero, and high, where it has the other one: by Newton's
 * method, and by bisection where that leaves the interval.
 */
static real eom_find_zero(const real *c, real sign, real low, real high)
{
    enum { MAX_ITERATIONS = 100 };
    real d[EOM_SAMPLES], x = low + (high - low)/2;

    eom_differentiate_series(d, c);
    for (int i = 0; i < MAX_ITERATIONS && high - low > 2*EOM_EPS*high; i++) {
        const real value = eom_evaluate_series(c, x);
        const real next = x - value/eom_evaluate_series(d, x);

        if (sign*value > 0)
            low = x;
        else
            high = x;
        if (eom_fabs(next - x) <= 2*EOM_EPS*high)
            break;
        x = next > low && next < high ? next : low + (high - low)/2;
    }
    return x;
}
