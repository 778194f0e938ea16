/* The larger of two, the first where the second is not a number; fmax would be a call of libm. */
EOMC_INLINE EOMC_REAL eomc_larger(EOMC_REAL a, EOMC_REAL b)
{
    return b > a ? b : a;
}
