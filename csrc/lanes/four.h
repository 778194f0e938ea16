/*
 * Four numbers at a time into an array: a vector load waits until numbers that were stored one by
 * one have reached the cache.
 */

/* to = a, b, c, d. */
EOMC_INLINE void eomc_put(EOMC_REAL *to, EOMC_REAL a, EOMC_REAL b, EOMC_REAL c, EOMC_REAL d)
{
    const eomc_four all = { a, b, c, d };

    *(eomc_four_unaligned *)to = all;
}
