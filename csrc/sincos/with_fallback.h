/*
 * s, c = sin x, cos x from s0, c0 = sin(x - d), cos(x - d), where d is small:
 *
 *     sin x = s0 + (c0 sin d + s0 (cos d - 1))
 *     cos x = c0 - (s0 sin d - c0 (cos d - 1))
 *
 * |d| <= 2^-6: by short polynomials, in half the time of sincos.  The branch is nearly always
 * predicted.  Anything else, a NaN too, goes to sincos.
 *
 * Error: what s0 and c0 bring, and one unit of rounding of 1 at most besides.  In sin d = d + d^3
 * (a0 + a1 d^2) the next term of Taylor's series, d^7/5040, is shared out by Chebyshev's rule; that
 * is off by 2^-57.3 at most, cos d - 1 by d^8/40320 < 2^-63.
 */
EOMC_INLINE void eomc_sincos_with_fallback(
    double x, double d, double s0, double c0, double *s, double *c)
{
    if (fabs(d) <= 0.015625) {
        const double z = d * d;
        const double a01 = eomc_mul_add(z, 0.008333284892733136, -0.16666666666518837);
        const double b01 = eomc_mul_add(z, -0.001388888888888889, 0.041666666666666664);
        const double a = d * a01, b = eomc_mul_add(z, b01, -0.5);
        const double more_s = eomc_mul_add(c0, a, s0 * b);
        const double more_c = eomc_mul_add(-s0, a, c0 * b);

        *s = eomc_mul_add(z, more_s, eomc_mul_add(c0, d, s0));
        *c = eomc_mul_add(z, more_c, eomc_mul_add(-s0, d, c0));
    } else {
        eomc_sincos(x, s, c);
    }
}
