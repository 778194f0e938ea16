/* Sine and cosine of each angle in a lane, of any size: one that is too large goes by itself. */
EOMC_INLINE void eomc_sincos_each_LANE(const eomc_LANE *x, eomc_LANE *s, eomc_LANE *c)
{
    eomc_LANE_mask failed = { 0 };

    eomc_sincos_LANE(*x, s, c, &failed);
    if (eomc_any_LANE(&failed))
        for (int k = 0; k < (int)EOMC_LANE_COUNT; k++) {
            EOMC_REAL sine, cosine;

            eomc_sincos_REAL((*x)[k], &sine, &cosine);
            (*s)[k] = sine;
            (*c)[k] = cosine;
        }
}
