/*
 * Sine and cosine of a lane of angles, |x| <= 2^13, without a branch: sincosf.h in vectors. Anything
 * larger gives nonsense. Quadrants by swapping and by signs.
 */
EOMC_INLINE void eomc_sincos_small_LANE(const eomc_LANE *angle, eomc_LANE *sine, eomc_LANE *cosine)
{
    typedef unsigned bits_LANE __attribute__((vector_size(EOMC_LANE_BYTES)));
    const float magic = 12582912.0f; /* 1.5 2^23: adding it rounds to an integer */
    const eomc_LANE x = *angle, shifted = x*0.63661975f + magic, n = shifted - magic;

    /* r = x - n pi/2, with pi/2 in parts of 11 bits: their products with n < 2^13 are exact,
     * whether compilers contract them or not */
    const eomc_LANE above = (x - n*1.5703125f) - n*0.0004837513f, second = n*7.5495336e-08f;
    const eomc_LANE rounded = above - second, remainder = (above - rounded) - second;
    const eomc_LANE r = rounded - (n*2.563283e-12f - remainder);

    /* sin r = r + r^3 P(r^2), cos r = 1 + r^2 (-1/2 + r^2 Q(r^2)); adding 0.0 keeps sin(-0.0) */
    const eomc_LANE z = r*r, r3 = r*z + 0.0f;
    const eomc_LANE p = z*(z*-0.00019517897f + 0.008332187f) + -0.16666655f;
    const eomc_LANE q = z*(z*2.4432327e-05f + -0.001388731f) + 0.041666646f;
    const bits_LANE sin_r = (bits_LANE)(r3*p + (r - n*6.1232336e-17f));
    const bits_LANE cos_r = (bits_LANE)(z*(z*q + -0.5f) + 1.0f);

    /* the last bits of the sum are those of the integer n: odd swaps sine and cosine */
    const bits_LANE m = (bits_LANE)shifted, swap = (sin_r ^ cos_r) & -(m & 1);
    const bits_LANE minus = (m >> 1) << 31;

    *sine = (eomc_LANE)(sin_r ^ swap ^ minus);
    *cosine = (eomc_LANE)(cos_r ^ swap ^ minus ^ (m << 31));
}

/* The same of any angle; one that is too large fails. */
EOMC_INLINE void eomc_sincos_LANE(eomc_LANE x, eomc_LANE *s, eomc_LANE *c, eomc_LANE_mask *failed)
{
    eomc_sincos_small_LANE(&x, s, c);
    *failed |= eomc_exceeds_LANE(x, 8192.0f);
}
