/* a where m, else b. */
EOMC_INLINE eomc_LANE eomc_select_LANE(eomc_LANE_mask m, eomc_LANE a, eomc_LANE b)
{
    return (eomc_LANE)((m & (eomc_LANE_mask)a) | (~m & (eomc_LANE_mask)b));
}

/* |x| */
EOMC_INLINE eomc_LANE eomc_magnitude_LANE(eomc_LANE x)
{
    return (eomc_LANE)((eomc_LANE_mask)x & EOMC_BITS_OF_SIZE);
}

/* The larger, and the smaller of two: b where one is no number. */
EOMC_INLINE eomc_LANE eomc_larger_LANE(eomc_LANE a, eomc_LANE b)
{
    return eomc_select_LANE(a > b, a, b);
}

EOMC_INLINE eomc_LANE eomc_smaller_LANE(eomc_LANE a, eomc_LANE b)
{
    return eomc_select_LANE(a < b, a, b);
}
