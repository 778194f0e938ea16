/*
 * Sine and cosine of one angle together, in single precision, inlined: sincos.h for float.
 *
 *     x = n pi/2 + r,   |r| <= pi/4,   a = cos(n pi/2),   b = -sin(n pi/2)
 *     sin x = a sin r - b cos r
 *     cos x = a cos r + b sin r
 *
 * Error: below 1.6 ulp in both for |x| <= 2^13; the largest of all floats there is
 * 1.523 with FMA and 1.545 without.  sin(-0.0f) is -0.0f.  There are no branches and
 * nothing is wider than a float, so a loop vectorises at full width, and scalar and
 * vector code of one build agree bit for bit.  Beyond 2^13 rad neighbouring floats are
 * 2^-10 rad apart and more: no angle is worth computing with there.
 *
 * Polynomials: minimax in the relative error on |r| <= 0.7862, by the Remez
 * exchange; from the lowest power up, each coefficient was rounded to a float
 * and the others were fitted again.  Their own relative error is 2^-27.9 in the
 * sine and 2^-33.0 in the cosine.  `python benchmarks/sincos.py --derive`
 * prints every constant below.
 *
 * Needs: rounding to nearest (the C default), arithmetic in float itself, and
 * no licence to reorder sums.
 */
#include <math.h>

#if defined __FAST_MATH__ || defined __ASSOCIATIVE_MATH__
#error "-ffast-math (-fassociative-math) breaks the argument reduction: compile without it"
#endif
#if defined __FLT_EVAL_METHOD__ && (__FLT_EVAL_METHOD__ == 1 || __FLT_EVAL_METHOD__ == 2)
#error "needs sums rounded to float, nothing wider: on 32-bit x86 use -msse2 -mfpmath=sse"
#endif

/* ARM's macro is for the precisions of __ARM_FP, in which 4 means single. */
#if defined __FMA__ || defined __FP_FAST_FMAF || defined FP_FAST_FMAF \
    || (defined __ARM_FEATURE_FMA && (__ARM_FP & 4))
#define EOMC_FAST_FMAF 1
#else
#define EOMC_FAST_FMAF 0
#endif

/* Inlined for certain: gcc would stop at some ten of them in one loop, and the loop would no longer
 * be put into vector registers. */
#ifndef EOMC_INLINE
#ifdef __GNUC__
#define EOMC_INLINE static inline __attribute__((always_inline))
#else
#define EOMC_INLINE static inline
#endif
#endif

/* a b + c: one rounding where the hardware has it, two elsewhere.  It is written out
 * so that the compiler finds nothing left to contract in one build and not in another. */
EOMC_INLINE float eomc_mul_addf(float a, float b, float c)
{
#if EOMC_FAST_FMAF
    return fmaf(a, b, c);
#else
    return a * b + c;
#endif
}

/* r for |x| <= 2^13; anything else gives nonsense. n: the integer, in the last bits of
 * shifted = n + 1.5 2^23. */
EOMC_INLINE float eomc_sincosf_reduce(float x, float *shifted)
{
    /* Floats next to 1.5 2^23 are 1 apart, so adding it and taking it off again rounds to the
     * nearest integer; 1.5, not 1, leaves room for negative ones. */
    const float magic = 12582912.0f;
    const float n = (*shifted = eomc_mul_addf(x, 0.63661975f, magic)) - magic;

    /* r = x - n pi/2, with pi/2 in parts.  All parts are positive, so that
     * x = -0.0f stays -0.0f. */
#if EOMC_FAST_FMAF
    const float above = fmaf(-n, 1.5707963f, x); /* exact */
    return fmaf(-n, 7.5497894e-08f, above);
#else
    /* Parts of 11 bits, but for the last: their products with n < 2^13 are exact. */
    const float above = (x - n * 1.5703125f) - n * 0.0004837513f; /* exact */
    const float second = n * 7.5495336e-08f;
    const float rounded = above - second;
    const float remainder = (above - rounded) - second;
    return rounded - (n * 2.563283e-12f - remainder);
#endif
}

/* sin r and cos r of a reduced angle. */
EOMC_INLINE void eomc_sincosf_series(float r, float shifted, float *sin_r,
    float *cos_r)
{
    const float n = shifted - 12582912.0f;

    /* The last part of pi/2 only matters where r is tiny and sin r = r: it goes into r_fine, which
     * is not waited for. */
#if EOMC_FAST_FMAF
    const float r_fine = fmaf(-n, 5.3903025e-15f, r);
#else
    const float r_fine = r - n * 6.1232336e-17f;
#endif

    /* sin r = r + r^3 P(r^2), cos r = 1 + r^2 (-1/2 + r^2 Q(r^2)).  Adding 0.0f makes
     * r^3 = -0.0f a +0.0f, which saves the sign of sin(-0.0f). */
    const float z = r * r;
    const float r3 = eomc_mul_addf(r, z, 0.0f);
    const float p12 = eomc_mul_addf(z, -0.00019517897f, 0.008332187f);
    const float q12 = eomc_mul_addf(z, 2.4432327e-05f, -0.001388731f);
    const float p = eomc_mul_addf(z, p12, -0.16666655f);
    const float q = eomc_mul_addf(z, q12, 0.041666646f);
    *sin_r = eomc_mul_addf(r3, p, r_fine);
    *cos_r = eomc_mul_addf(z, eomc_mul_addf(z, q, -0.5f), 1.0f);
}

/* s = sin x, c = cos x for |x| <= 2^13; anything else gives nonsense. */
EOMC_INLINE void eomc_sincosf_small(float x, float *s, float *c)
{
    const float magic = 12582912.0f;
    float shifted, sin_r, cos_r;
    const float r = eomc_sincosf_reduce(x, &shifted);

    eomc_sincosf_series(r, shifted, &sin_r, &cos_r);

    /* m = n modulo 4, between -2 and 2; a and b are then exact, and ready before r is.  Not a
     * conditional, which would become a jump.  0.0f - m, not -m: b = +0.0f keeps sin(-0.0f). */
    const float n = shifted - magic;
    const float m = n - 4.0f * (eomc_mul_addf(n, 0.25f, magic) - magic);
    const float a = 1.0f - fabsf(m);
    const float b = (0.0f - m) * (2.0f - fabsf(m));

    /* Exact: one product is zero, the other has a factor of 1 or -1. */
    *s = eomc_mul_addf(-b, cos_r, a * sin_r);
    *c = eomc_mul_addf(b, sin_r, a * cos_r);
}

/* s = sin x, c = cos x for every x; libm answers where |x| > 2^13, infinite or NaN. */
static inline void eomc_sincosf(float x, float *s, float *c)
{
    if (fabsf(x) <= 8192.0f) {
        eomc_sincosf_small(x, s, c);
    } else {
        *s = sinf(x);
        *c = cosf(x);
    }
}
