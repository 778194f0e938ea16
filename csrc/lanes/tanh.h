/*
 * Hyperbolic tangent of a lane, without a branch, of any argument.
 *
 *     tanh x = x - x (D(x^2) - N(x^2))/D(x^2),   |x| <= 0.84
 *     tanh x = 1 - 2/(e^2x + 1),                  x  >  0.84
 *
 * Error: below 1.1 ulp. Two forms as in Cody & Waite, chapter 13, which share a division; x N/D is
 * the ninth convergent of Lambert's continued fraction x/(1 + x^2/(3 + x^2/(5 + ...))), off by 2^-57
 * of it at most.
 */
EOMC_INLINE eomc_LANE eomc_tanh_LANE(eomc_LANE x)
{
    typedef unsigned long long bits_LANE __attribute__((vector_size(EOMC_LANE_BYTES)));
    const eomc_LANE size = eomc_magnitude_LANE(x), z = size*size;
    const eomc_LANE one = eomc_same_LANE(1.0), two = eomc_same_LANE(2.0);
    const eomc_LANE less = z*(z*(z*44.0 + 12870.0) + 810810.0) + 11486475.0;
    const eomc_LANE series = z*(z*(z*(z*45.0 + 13860.0) + 945945.0) + 16216200.0) + 34459425.0;

    /* from 20 on it is 1 */
    eomc_LANE n;
    const eomc_LANE y = eomc_exp_reduced_LANE(
        eomc_smaller_LANE(size, eomc_same_LANE(20.0))*2.0, &n);
    const eomc_LANE power = (eomc_LANE)((bits_LANE)y + ((bits_LANE)n << 52));

    const eomc_LANE_mask large = size > 0.84;
    const eomc_LANE over = eomc_select_LANE(large, two, size*z*less);
    const eomc_LANE under = eomc_select_LANE(large, power + 1.0, series);
    const eomc_LANE result = eomc_select_LANE(large, one, size) - over/under;

    return (eomc_LANE)((eomc_LANE_mask)result | ((eomc_LANE_mask)x & ~EOMC_BITS_OF_SIZE));
}
