/*
 * Sines and cosines rotated by a small angle d, without a branch, for loops over many:
 *
 *     sin(x + d) = s0 + (c0 sin d + s0 (cos d - 1))
 *     cos(x + d) = c0 - (s0 sin d - c0 (cos d - 1))
 *
 * Error: what s0 and c0 bring, and one unit of rounding of 1 at most besides.  In sin d = d + d^3 A
 * and cos d = 1 + d^2 (-1/2 + d^2 B), A and B are Chebyshev series in d^2, cut off; that is off by
 * 2^-56.7 at most.
 */

/* By d, |d| <= 2^-6. */
EOMC_INLINE void eomc_sincos_rotate(double d, double s0, double c0,
    double *s, double *c)
{
    const double z = d * d;
    const double a = eomc_mul_add(z, 0.008333284892876857, -0.1666666666651884);
    const double b = eomc_mul_add(z, -0.0013888828338282364, 0.04166666666648188);
    const double sin_d = eomc_mul_add(d * z, a, d);
    const double less = z * eomc_mul_add(z, b, -0.5);

    *s = eomc_mul_add(c0, sin_d, eomc_mul_add(s0, less, s0));
    *c = eomc_mul_add(-s0, sin_d, eomc_mul_add(c0, less, c0));
}

/* By -d and by d, |d| <= 2^-3. */
EOMC_INLINE void eomc_sincos_rotate_both(double d, double s0, double c0,
    double *s_back, double *c_back, double *s_on, double *c_on)
{
    const double z = d * d;
    const double a23 = eomc_mul_add(z, 2.754949151820351e-06, -0.0001984126907687799);
    const double a123 = eomc_mul_add(z, a23, 0.008333333333309446);
    const double b12 = eomc_mul_add(z, 2.479512941491486e-05, -0.00138888885105114);
    const double a = eomc_mul_add(z, a123, -0.16666666666666666);
    const double b = eomc_mul_add(z, b12, 0.04166666666663382);
    const double sin_d = eomc_mul_add(d * z, a, d);
    const double less = z * eomc_mul_add(z, b, -0.5);
    const double s1 = eomc_mul_add(s0, less, s0);
    const double c1 = eomc_mul_add(c0, less, c0);

    *s_back = eomc_mul_add(-c0, sin_d, s1);
    *c_back = eomc_mul_add(s0, sin_d, c1);
    *s_on = eomc_mul_add(c0, sin_d, s1);
    *c_on = eomc_mul_add(-s0, sin_d, c1);
}
