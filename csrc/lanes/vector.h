/*
 * A lane of several numbers in one register. Failures are sign bits, or-ed without a branch; what
 * failed is computed once more by itself, which also tells why.
 */
typedef EOMC_REAL eomc_LANE
    __attribute__((vector_size(EOMC_LANE_BYTES), aligned(EOMC_LANE_ALIGNED), may_alias));
/* anywhere in memory */
typedef eomc_LANE eomc_LANE_unaligned __attribute__((aligned(sizeof(EOMC_REAL))));
typedef EOMC_INTEGER eomc_LANE_mask
    __attribute__((vector_size(EOMC_LANE_BYTES), aligned(EOMC_LANE_ALIGNED), may_alias));

enum { EOMC_LANE_COUNT = EOMC_LANE_BYTES/sizeof(EOMC_REAL) };

/* x in every lane. */
EOMC_INLINE eomc_LANE eomc_same_LANE(EOMC_REAL x)
{
    const eomc_LANE zero = { 0 };

    return x - zero;
}

/* Whether |x| > most; undefined for NaN. */
EOMC_INLINE eomc_LANE_mask eomc_exceeds_LANE(eomc_LANE x, EOMC_REAL most)
{
    return (eomc_LANE_mask)(most - (eomc_LANE)((eomc_LANE_mask)x & EOMC_BITS_OF_SIZE));
}

/* Whether x <= 0, for a pivot minus its rounding error; false for NaN, which is not finite. */
EOMC_INLINE eomc_LANE_mask
eomc_not_positive_LANE(eomc_LANE x)
{
    return x <= 0;
}

EOMC_INLINE eomc_LANE_mask eomc_not_finite_LANE(eomc_LANE x)
{
    return (x - x == 0) == 0;
}

EOMC_INLINE int eomc_any_LANE(const eomc_LANE_mask *failed)
{
    EOMC_INTEGER all = 0;

    for (int i = 0; i < EOMC_LANE_COUNT; i++)
        all |= (*failed)[i];
    return all < 0;
}
