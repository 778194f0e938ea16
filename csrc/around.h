/* At x - d, x and x + d, |x| <= 2^20, |d| <= 2^-3. */
EOMC_INLINE void eomc_sincos_around(double x, double d,
    double *s_back, double *c_back, double *s, double *c, double *s_on, double *c_on, double *far)
{
    eomc_sincos_small(x, s, c);
    eomc_turn_both(d, *s, *c, s_back, c_back, s_on, c_on, far);
    *far = eomc_far_at(x, *far);
}
