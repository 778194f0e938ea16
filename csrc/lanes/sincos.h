/*
 * Sine and cosine of a lane of angles, |x| <= 2^20, without a branch: sincos.h in vectors. Anything
 * larger gives nonsense. Quadrants by swapping and by signs.
 */
EOMC_INLINE void eomc_sincos_small_LANE(const eomc_LANE *angle, eomc_LANE *sine, eomc_LANE *cosine)
{
    typedef unsigned long long bits_LANE __attribute__((vector_size(EOMC_LANE_BYTES)));
    const double magic = 6755399441055744.0; /* 1.5 2^52: adding it rounds to an integer */
    const eomc_LANE x = *angle, shifted = x*0.6366197723675814 + magic, n = shifted - magic;

    /* r = x - n pi/2, with pi/2 in parts of 33 bits: their products with n < 2^20 are exact,
     * whether compilers contract them or not */
    const eomc_LANE above = x - n*1.5707963267341256, second = n*6.077100506303966e-11;
    const eomc_LANE rounded = above - second, remainder = (above - rounded) - second;
    const eomc_LANE r = rounded - (n*2.0222662487111665e-21 - remainder);

    /* sin r = r + r^3 P(r^2), cos r = 1 + r^2 (-1/2 + r^2 Q(r^2)); adding 0.0 keeps sin(-0.0) */
    const eomc_LANE z = r*r, z2 = z*z, r3 = r*z + 0.0;
    const eomc_LANE p01 = z*0.00833333333332184 + -0.1666666666666663;
    const eomc_LANE p23 = z*2.755731353851118e-06 + -0.00019841269829358528;
    const eomc_LANE p45 = z*1.5895433185809817e-10 + -2.505073438811647e-08;
    const eomc_LANE q01 = z*-0.0013888888888873342 + 0.041666666666666595;
    const eomc_LANE q23 = z*-2.755731421702807e-07 + 2.4801587289002062e-05;
    const eomc_LANE q45 = z*-1.1358749082675865e-11 + 2.0875705393755688e-09;
    const eomc_LANE p = z2*(z2*p45 + p23) + p01, q = z2*(z2*q45 + q23) + q01;
    const bits_LANE sin_r = (bits_LANE)(r3*p + (r - n*8.478427660348229e-32));
    const bits_LANE cos_r = (bits_LANE)(z*(z*q + -0.5) + 1.0);

    /* the last bits of the sum are those of the integer n: odd swaps sine and cosine */
    const bits_LANE m = (bits_LANE)shifted, swap = (sin_r ^ cos_r) & -(m & 1);
    const bits_LANE minus = (m >> 1) << 63;

    *sine = (eomc_LANE)(sin_r ^ swap ^ minus);
    *cosine = (eomc_LANE)(cos_r ^ swap ^ minus ^ (m << 63));
}

/* The same of any angle; one that is too large fails. */
EOMC_INLINE void eomc_sincos_LANE(eomc_LANE x, eomc_LANE *s, eomc_LANE *c, eomc_LANE_mask *failed)
{
    eomc_sincos_small_LANE(&x, s, c);
    *failed |= eomc_exceeds_LANE(x, 1048576.0);
}
