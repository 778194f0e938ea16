/*
 * Numbers from scalar code for loops in vector registers, stored four at a time: a vector load waits
 * until numbers that were stored one by one have reached the cache.
 */
#ifdef __GNUC__
typedef double eomc_four __attribute__((vector_size(32), aligned(8)));
#endif

/* to = a, b, c, d. */
EOMC_INLINE void eomc_store(double *to, double a, double b, double c, double d)
{
#ifdef __GNUC__
    const eomc_four all = { a, b, c, d };

    *(eomc_four *)to = all;
#else
    to[0] = a, to[1] = b, to[2] = c, to[3] = d;
#endif
}

/* to = x and y interleaved, four of each, in the order that takes one shuffle of either half:
 * x0 y0, x2 y2, x1 y1, x3 y3. */
EOMC_INLINE void eomc_interleave(double *to, const double *x, const double *y)
{
#ifdef __GNUC__
    const eomc_four a = *(const eomc_four *)x, b = *(const eomc_four *)y;
    const eomc_four even = { a[0], b[0], a[2], b[2] }, odd = { a[1], b[1], a[3], b[3] };

    *(eomc_four *)to = even;
    *(eomc_four *)(to + 4) = odd;
#else
    to[0] = x[0], to[2] = x[2], to[4] = x[1], to[6] = x[3];
    to[1] = y[0], to[3] = y[2], to[5] = y[1], to[7] = y[3];
#endif
}
