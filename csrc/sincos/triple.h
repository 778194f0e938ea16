/*
 * Sines and cosines at x - d, x and x + d, |x| <= 2^20, |d| <= 2^-3. far: |x| and d^2 over the largest that are
 * allowed are added to it; where it stays below 1, none of them was too large.
 */
EOMC_INLINE void eomc_sincos_triple(double x, double d,
    double *s_back, double *c_back, double *s, double *c, double *s_on, double *c_on, double *far)
{
    eomc_sincos_small(x, s, c);
    eomc_sincos_rotate_both(d, *s, *c, s_back, c_back, s_on, c_on);
    *far = eomc_mul_add(d * d, 64.0, *far);
    *far = eomc_mul_add(fabs(x), 9.5367431640625e-07, *far);
}
