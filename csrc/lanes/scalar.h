/* Whether |x| > most, or not a number. */
EOMC_INLINE int eomc_exceeds(EOMC_REAL x, EOMC_REAL most)
{
    return !(fabs_REAL(x) <= most);
}
