/*
 * Sines and cosines rotated by a small angle d, in single precision: incremental.h for float.
 *
 * Error: what s0 and c0 bring, and one unit of rounding of 1 at most besides; the polynomials are
 * off by 2^-27 of 1 at most.
 */

/* By d, |d| <= 2^-4. */
EOMC_INLINE void eomc_sincosf_rotate(float d, float s0, float c0, float *s, float *c)
{
    const float z = d * d;
    const float sin_d = eomc_mul_addf(d * z, -0.16665038f, d);
    const float less = z * eomc_mul_addf(z, 0.041663956f, -0.5f);

    *s = eomc_mul_addf(c0, sin_d, eomc_mul_addf(s0, less, s0));
    *c = eomc_mul_addf(-s0, sin_d, eomc_mul_addf(c0, less, c0));
}

/* By -d and by d, |d| <= 1/4. */
EOMC_INLINE void eomc_sincosf_rotate_both(float d, float s0, float c0,
    float *s_back, float *c_back, float *s_on, float *c_on)
{
    const float z = d * d;
    const float a = eomc_mul_addf(z, 0.008320942f, -0.16666657f);
    const float b = eomc_mul_addf(z, -0.0013873398f, 0.041666653f);
    const float sin_d = eomc_mul_addf(d * z, a, d);
    const float less = z * eomc_mul_addf(z, b, -0.5f);
    const float s1 = eomc_mul_addf(s0, less, s0);
    const float c1 = eomc_mul_addf(c0, less, c0);

    *s_back = eomc_mul_addf(-c0, sin_d, s1);
    *c_back = eomc_mul_addf(s0, sin_d, c1);
    *s_on = eomc_mul_addf(c0, sin_d, s1);
    *c_on = eomc_mul_addf(-s0, sin_d, c1);
}
