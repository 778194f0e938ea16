/*
 * s = sin x, c = cos x of a reduced angle by eomc_sincosf_small bit for bit, for loops: quadrants
 * by swapping and by signs, which takes fewer operations in vector registers, and more in others.
 */
EOMC_INLINE void eomc_sincosf_of_reduced(float r, float shift, float *s,
    float *c)
{
    union {
        float number;
        unsigned bits;
        int integer;
    } shifted, sine, cosine, odd, high;
    float sin_r, cos_r;

    eomc_sincosf_series(r, shift, &sin_r, &cos_r);
    shifted.number = shift;

    /* n = 0, 1, 2, 3: s = sin r, cos r, -sin r, -cos r; c = cos r, -sin r, -cos r, sin r.
     * The last two bits of n, each as a sign, which is what vector registers select by. */
    odd.bits = shifted.bits << 31;
    high.bits = (shifted.bits << 30) & ((unsigned)1 << 31);
    sine.number = odd.integer < 0 ? cos_r : sin_r;
    cosine.number = odd.integer < 0 ? sin_r : cos_r;
    sine.bits ^= high.bits;
    cosine.bits ^= high.bits ^ odd.bits;
    *s = sine.number;
    *c = cosine.number;
}

/* The same of any angle that eomc_sincosf_small can take. */
EOMC_INLINE void eomc_sincosf_by_bits(float x, float *s, float *c)
{
    float shifted;
    const float r = eomc_sincosf_reduce(x, &shifted);

    eomc_sincosf_of_reduced(r, shifted, s, c);
}
