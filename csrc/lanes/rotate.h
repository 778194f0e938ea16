/*
 * Sines and cosines rotated by a small angle d:
 *
 *     sin(x + d) = s0 + (c0 sin d + s0 (cos d - 1))
 *     cos(x + d) = c0 - (s0 sin d - c0 (cos d - 1))
 *
 * Error: what s0 and c0 bring, and one unit of rounding of 1 at most besides. In sin d = d + d^3 A
 * and cos d = 1 + d^2 (-1/2 + d^2 B), A and B are Chebyshev series in d^2, cut off; that is off by
 * 2^-56.7 at most.
 */

/* In place by d, |d| <= 2^-6. */
EOMC_INLINE void eomc_rotate_LANE(eomc_LANE d, eomc_LANE *s, eomc_LANE *c)
{
    const eomc_LANE s0 = *s, c0 = *c, z = d*d;
    const eomc_LANE a = z*0.008333284892876857 + -0.1666666666651884;
    const eomc_LANE b = z*-0.0013888828338282364 + 0.04166666666648188;
    const eomc_LANE sin_d = d*z*a + d, less = z*(z*b + -0.5);

    *s = c0*sin_d + (s0*less + s0);
    *c = (c0*less + c0) - s0*sin_d;
}

/* By -d and by d, |d| <= 2^-3. */
EOMC_INLINE void eomc_rotate_both_LANE(eomc_LANE d, eomc_LANE s0, eomc_LANE c0,
    eomc_LANE *s_back, eomc_LANE *c_back, eomc_LANE *s_on, eomc_LANE *c_on)
{
    const eomc_LANE z = d*d;
    const eomc_LANE a23 = z*2.754949151820351e-06 + -0.0001984126907687799;
    const eomc_LANE a = z*(z*a23 + 0.008333333333309446) + -0.16666666666666666;
    const eomc_LANE b12 = z*2.479512941491486e-05 + -0.00138888885105114;
    const eomc_LANE b = z*b12 + 0.04166666666663382;
    const eomc_LANE sin_d = d*z*a + d, less = z*(z*b + -0.5);
    const eomc_LANE s1 = s0*less + s0, c1 = c0*less + c0;

    *s_back = s1 - c0*sin_d;
    *c_back = c1 + s0*sin_d;
    *s_on = s1 + c0*sin_d;
    *c_on = c1 - s0*sin_d;
}
