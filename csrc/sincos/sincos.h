/*
 * Sine and cosine of one angle together, in double precision, inlined.
 *
 *     x = n pi/2 + r,   |r| <= pi/4,   a = cos(n pi/2),   b = -sin(n pi/2)
 *     sin x = a sin r - b cos r
 *     cos x = a cos r + b sin r
 *
 * Error: below 1.6 ulp in both for |x| <= 2^20, also next to every multiple of
 * pi/2; the largest seen in 14 million random points is 1.52.  sin(-0.0) is -0.0.
 * There are no branches, so a loop vectorises, and scalar and vector code of one
 * build agree bit for bit.
 *
 * Polynomials: minimax in the relative error on |r| <= 0.7854, by the Remez
 * exchange; from the lowest power up, each coefficient was rounded to a double
 * and the others were fitted again.  Their own relative error is 2^-57.9 in the
 * sine and 2^-63.9 in the cosine.  `python benchmarks/sincos.py --derive`
 * prints every constant below.
 *
 * Needs: rounding to nearest (the C default), arithmetic in double itself, and
 * no licence to reorder sums.
 */
#include <math.h>

#if defined __FAST_MATH__ || defined __ASSOCIATIVE_MATH__
#error "-ffast-math (-fassociative-math) breaks the argument reduction: compile without it"
#endif
#if defined __FLT_EVAL_METHOD__ && __FLT_EVAL_METHOD__ == 2
#error "needs sums rounded to double, not to long double: on 32-bit x86 use -msse2 -mfpmath=sse"
#endif

/* ARM's macro means single precision alone on Cortex-M4F and M33; __ARM_FP has 8 for double. */
#if defined __FMA__ || defined __FP_FAST_FMA || defined FP_FAST_FMA \
    || (defined __ARM_FEATURE_FMA && (__ARM_FP & 8))
#define EOMC_FAST_FMA 1
#else
#define EOMC_FAST_FMA 0
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
EOMC_INLINE double eomc_mul_add(double a, double b, double c)
{
#if EOMC_FAST_FMA
    return fma(a, b, c);
#else
    return a * b + c;
#endif
}

/* r for |x| <= 2^20; anything else gives nonsense. n: the integer, in the last bits of
 * shifted = n + 1.5 2^52. */
EOMC_INLINE double eomc_sincos_reduce(double x, double *shifted)
{
    /* Doubles next to 1.5 2^52 are 1 apart, so adding it and taking it off again rounds to the
     * nearest integer; 1.5, not 1, leaves room for negative ones. */
    const double magic = 6755399441055744.0;
    const double n = (*shifted = eomc_mul_add(x, 0.6366197723675814, magic)) - magic;

    /* r = x - n pi/2, with pi/2 in parts.  All parts are positive, so that
     * x = -0.0 stays -0.0. */
#if EOMC_FAST_FMA
    const double above = fma(-n, 1.5707963267948966, x); /* exact */
    return fma(-n, 6.123233995736765e-17, above);
#else
    /* Parts of 33 bits: their products with n < 2^20 are exact. */
    const double above = x - n * 1.5707963267341256; /* exact */
    const double second = n * 6.077100506303966e-11;
    const double rounded = above - second;
    const double remainder = (above - rounded) - second;
    return rounded - (n * 2.0222662487111665e-21 - remainder);
#endif
}

/* sin r and cos r of a reduced angle. */
EOMC_INLINE void eomc_sincos_series(double r, double shifted, double *sin_r,
    double *cos_r)
{
    const double n = shifted - 6755399441055744.0;

    /* The last part of pi/2 only matters where r is tiny and sin r = r: it goes into r_fine, which
     * is not waited for. */
#if EOMC_FAST_FMA
    const double r_fine = fma(-n, 1.0828566739219139e-32, r);
#else
    const double r_fine = r - n * 8.478427660348229e-32;
#endif

    /* sin r = r + r^3 P(r^2), cos r = 1 + r^2 (-1/2 + r^2 Q(r^2)), with P and Q summed in pairs
     * (Estrin).  Adding 0.0 makes r^3 = -0.0 a +0.0, which saves the sign of sin(-0.0). */
    const double z = r * r;
    const double z2 = z * z;
    const double r3 = eomc_mul_add(r, z, 0.0);
    const double p01 = eomc_mul_add(z, 0.00833333333332184, -0.1666666666666663);
    const double p23 = eomc_mul_add(z, 2.755731353851118e-06, -0.00019841269829358528);
    const double p45 = eomc_mul_add(z, 1.5895433185809817e-10, -2.505073438811647e-08);
    const double q01 = eomc_mul_add(z, -0.0013888888888873342, 0.041666666666666595);
    const double q23 = eomc_mul_add(z, -2.755731421702807e-07, 2.4801587289002062e-05);
    const double q45 = eomc_mul_add(z, -1.1358749082675865e-11, 2.0875705393755688e-09);
    const double p = eomc_mul_add(z2, eomc_mul_add(z2, p45, p23), p01);
    const double q = eomc_mul_add(z2, eomc_mul_add(z2, q45, q23), q01);
    *sin_r = eomc_mul_add(r3, p, r_fine);
    *cos_r = eomc_mul_add(z, eomc_mul_add(z, q, -0.5), 1.0);
}

/* s = sin x, c = cos x for |x| <= 2^20; anything else gives nonsense. */
EOMC_INLINE void eomc_sincos_small(double x, double *s, double *c)
{
    const double magic = 6755399441055744.0;
    double shifted, sin_r, cos_r;
    const double r = eomc_sincos_reduce(x, &shifted);

    eomc_sincos_series(r, shifted, &sin_r, &cos_r);

    /* m = n modulo 4, between -2 and 2; a and b are then exact, and ready before r is.  Not a
     * conditional, which would become a jump.  0.0 - m, not -m: b = +0.0 keeps sin(-0.0). */
    const double n = shifted - magic;
    const double m = n - 4.0 * (eomc_mul_add(n, 0.25, magic) - magic);
    const double a = 1.0 - fabs(m);
    const double b = (0.0 - m) * (2.0 - fabs(m));

    /* Exact: one product is zero, the other has a factor of 1 or -1. */
    *s = eomc_mul_add(-b, cos_r, a * sin_r);
    *c = eomc_mul_add(b, sin_r, a * cos_r);
}

/* s = sin x, c = cos x for every x; libm answers where |x| > 2^20, infinite or NaN. */
static inline void eomc_sincos(double x, double *s, double *c)
{
    if (fabs(x) <= 1048576.0) {
        eomc_sincos_small(x, s, c);
    } else {
        *s = sin(x);
        *c = cos(x);
    }
}
