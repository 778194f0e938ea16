/* to = x and y interleaved, four of each, in the order that takes one shuffle of either half:
 * x0 y0, x2 y2, x1 y1, x3 y3. */
EOMC_INLINE void eomc_interleave(eomc_two *to, const EOMC_REAL *x, const EOMC_REAL *y)
{
    const eomc_four a = *(const eomc_four_unaligned *)x, b = *(const eomc_four_unaligned *)y;
    const eomc_four even = { a[0], b[0], a[2], b[2] }, odd = { a[1], b[1], a[3], b[3] };

    *(eomc_four_unaligned *)to = even;
    *(eomc_four_unaligned *)(to + 2) = odd;
}
