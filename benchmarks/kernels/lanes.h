/*
 * What the kernels beside this file share: four doubles side by side, and their sine and cosine.
 *
 * Needs AVX2 and FMA. csrc/sincos/sincos.h is on the include path: eomc_sincos, for arguments that
 * sincos4 can't take, and the derivation of the coefficients.
 */
#ifndef LANES_H
#define LANES_H

#include <immintrin.h>
#include <math.h>
#include <string.h>

#include "sincos.h"

#if !defined __AVX2__ || !defined __FMA__
#error "the kernels are written for AVX2 with FMA"
#endif

#define INLINE static inline __attribute__((always_inline))

typedef __m256d v4;
typedef __m128d v2;

#define ALL4(a) _mm256_set1_pd(a)
#define ALL2(a) _mm_set1_pd(a)

static const double LIMIT = 0x1p20; /* of sincos4 */

INLINE v4 mad4(v4 a, v4 b, v4 c) { return _mm256_fmadd_pd(a, b, c); }
INLINE v4 nmad4(v4 a, v4 b, v4 c) { return _mm256_fnmadd_pd(a, b, c); }
INLINE v2 mad2(v2 a, v2 b, v2 c) { return _mm_fmadd_pd(a, b, c); }
INLINE v2 nmad2(v2 a, v2 b, v2 c) { return _mm_fnmadd_pd(a, b, c); }

/*
 * s = sin x, c = cos x for |x| <= LIMIT, to an ulp or two of 1: the reduction has two parts of
 * pi/2, not three. Quadrants by swapping and signs, taken from the last bits of x 2/pi + 1.5 2^52.
 * `pairs`: polynomials summed in pairs (Estrin), where the latency counts; else Horner's.
 */
INLINE void sincos4(v4 x, v4 *s, v4 *c, int pairs)
{
    const v4 magic = ALL4(6755399441055744.0);
    const v4 shifted = mad4(x, ALL4(0.6366197723675814), magic), n = shifted - magic;
    const __m256i bits = _mm256_castpd_si256(shifted);
    const v4 odd = _mm256_castsi256_pd(_mm256_slli_epi64(bits, 63));
    const v4 half = _mm256_castsi256_pd(_mm256_slli_epi64(bits, 62));
    const v4 sign_s = _mm256_and_pd(half, ALL4(-0.0)), sign_c = _mm256_xor_pd(sign_s, odd);
    const v4 r = nmad4(n, ALL4(6.123233995736765e-17), nmad4(n, ALL4(1.5707963267948966), x));
    const v4 z = r*r;
    const v4 p0 = ALL4(-0.1666666666666663), p1 = ALL4(0.00833333333332184);
    const v4 p2 = ALL4(-0.00019841269829358528), p3 = ALL4(2.755731353851118e-06);
    const v4 p4 = ALL4(-2.505073438811647e-08), p5 = ALL4(1.5895433185809817e-10);
    const v4 q0 = ALL4(0.041666666666666595), q1 = ALL4(-0.0013888888888873342);
    const v4 q2 = ALL4(2.4801587289002062e-05), q3 = ALL4(-2.755731421702807e-07);
    const v4 q4 = ALL4(2.0875705393755688e-09), q5 = ALL4(-1.1358749082675865e-11);
    v4 p, q;

    if (pairs) {
        const v4 z2 = z*z;
        p = mad4(z2, mad4(z2, mad4(z, p5, p4), mad4(z, p3, p2)), mad4(z, p1, p0));
        q = mad4(z2, mad4(z2, mad4(z, q5, q4), mad4(z, q3, q2)), mad4(z, q1, q0));
    } else {
        p = mad4(mad4(mad4(mad4(mad4(p5, z, p4), z, p3), z, p2), z, p1), z, p0);
        q = mad4(mad4(mad4(mad4(mad4(q5, z, q4), z, q3), z, q2), z, q1), z, q0);
    }
    const v4 sin_r = mad4(r*z, p, r), cos_r = mad4(z, mad4(z, q, ALL4(-0.5)), ALL4(1.0));
    *s = _mm256_xor_pd(_mm256_blendv_pd(sin_r, cos_r, odd), sign_s);
    *c = _mm256_xor_pd(_mm256_blendv_pd(cos_r, sin_r, odd), sign_c);
}

#endif
