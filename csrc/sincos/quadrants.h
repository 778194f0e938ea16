/*
 * s = sin x, c = cos x of a reduced angle by eomc_sincos_small bit for bit, for loops: quadrants
 * by swapping and by signs, which takes fewer operations in vector registers, and more in others.
 */
EOMC_INLINE void eomc_sincos_of_reduced(double r, double shift, double *s,
    double *c)
{
    union {
        double number;
        unsigned long long bits;
        long long integer;
    } shifted, sine, cosine, odd, high;
    double sin_r, cos_r;

    eomc_sincos_series(r, shift, &sin_r, &cos_r);
    shifted.number = shift;

    /* n = 0, 1, 2, 3: s = sin r, cos r, -sin r, -cos r; c = cos r, -sin r, -cos r, sin r.
     * The last two bits of n, each as a sign, which is what vector registers select by. */
    odd.bits = shifted.bits << 63;
    high.bits = (shifted.bits << 62) & ((unsigned long long)1 << 63);
    sine.number = odd.integer < 0 ? cos_r : sin_r;
    cosine.number = odd.integer < 0 ? sin_r : cos_r;
    sine.bits ^= high.bits;
    cosine.bits ^= high.bits ^ odd.bits;
    *s = sine.number;
    *c = cosine.number;
}

/* The same of any angle that eomc_sincos_small can take. */
EOMC_INLINE void eomc_sincos_by_bits(double x, double *s, double *c)
{
    double shifted;
    const double r = eomc_sincos_reduce(x, &shifted);

    eomc_sincos_of_reduced(r, shifted, s, c);
}
