/*
 * Hyperbolic tangent of a lane in single precision, without a branch, of any argument.
 *
 *     tanh x = x - x (D(x^2) - N(x^2))/D(x^2),   |x| <= 0.84
 *     tanh x = 1 - 2/(e^2x + 1),                  x  >  0.84
 *
 * Error: below 1.1 ulp. Two forms as in Cody & Waite, chapter 13, which share a division; x N/D is
 * the sixth convergent of Lambert's continued fraction x/(1 + x^2/(3 + x^2/(5 + ...))), off by 2^-33
 * of it at most.
 */
EOMC_INLINE eomc_LANE eomc_tanh_LANE(eomc_LANE x)
{
    typedef unsigned bits_LANE __attribute__((vector_size(EOMC_LANE_BYTES)));
    const eomc_LANE size = eomc_magnitude_LANE(x), z = size*size;
    const eomc_LANE one = eomc_same_LANE(1.0f), two = eomc_same_LANE(2.0f);
    const eomc_LANE less = z*(z + 189.0f) + 3465.0f;
    const eomc_LANE series = z*(z*(z + 210.0f) + 4725.0f) + 10395.0f;

    /* from 10 on it is 1 */
    eomc_LANE n;
    const eomc_LANE y = eomc_exp_reduced_LANE(
        eomc_smaller_LANE(size, eomc_same_LANE(10.0f))*2.0f, &n);
    const eomc_LANE power = (eomc_LANE)((bits_LANE)y + ((bits_LANE)n << 23));

    const eomc_LANE_mask large = size > 0.84f;
    const eomc_LANE over = eomc_select_LANE(large, two, size*z*less);
    const eomc_LANE under = eomc_select_LANE(large, power + 1.0f, series);
    const eomc_LANE result = eomc_select_LANE(large, one, size) - over/under;

    return (eomc_LANE)((eomc_LANE_mask)result | ((eomc_LANE_mask)x & ~EOMC_BITS_OF_SIZE));
}
