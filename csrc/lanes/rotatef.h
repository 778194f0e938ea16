/*
 * Sines and cosines rotated by a small angle d, in single precision: rotate.h for float.
 *
 * Error: what s0 and c0 bring, and one unit of rounding of 1 at most besides; the polynomials are
 * off by 2^-27 of 1 at most.
 */

/* In place by d, |d| <= 2^-4. */
EOMC_INLINE void eomc_rotate_LANE(eomc_LANE d, eomc_LANE *s, eomc_LANE *c)
{
    const eomc_LANE s0 = *s, c0 = *c, z = d*d;
    const eomc_LANE sin_d = d*z*-0.16665038f + d, less = z*(z*0.041663956f + -0.5f);

    *s = c0*sin_d + (s0*less + s0);
    *c = (c0*less + c0) - s0*sin_d;
}

/* By -d and by d, |d| <= 1/4. */
EOMC_INLINE void eomc_rotate_both_LANE(eomc_LANE d, eomc_LANE s0, eomc_LANE c0,
    eomc_LANE *s_back, eomc_LANE *c_back, eomc_LANE *s_on, eomc_LANE *c_on)
{
    const eomc_LANE z = d*d;
    const eomc_LANE a = z*0.008320942f + -0.16666657f, b = z*-0.0013873398f + 0.041666653f;
    const eomc_LANE sin_d = d*z*a + d, less = z*(z*b + -0.5f);
    const eomc_LANE s1 = s0*less + s0, c1 = c0*less + c0;

    *s_back = s1 - c0*sin_d;
    *c_back = c1 + s0*sin_d;
    *s_on = s1 + c0*sin_d;
    *c_on = c1 - s0*sin_d;
}
