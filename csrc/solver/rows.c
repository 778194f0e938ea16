/* Rows of runs by fixed steps. */

/* The number of the step before a row, or more than `end`. since: time from that step to the row, 0 within rounding. */
static long eom_row_step(real *since, const eom_options *options, long row, long end)
{
    static const real NEAR = (real)1e-12, ROUNDING = 4*EOM_EPS; /* of times: fraction of a step, and relative */
    real x, near;
    long n = LONG_MAX;

    *since = 0;
    if (row >= options->rows || !options->times)
        return row < options->rows ? options->every*row : n;
    x = (options->times[row] - options->t0)/options->h;
    near = NEAR + ROUNDING*(x + eom_fabs(options->t0)/options->h);
    if (x + near < (real)end + 1)
        n = x > 0 ? (long)(x + near) : 0;
    if (x - (real)n >= near)
        *since = options->times[row] - (options->t0 + (real)n*options->h);
    return n;
}
