/*
 * Classical RK4 of the Panda arm, every torque zero: the limit for the generator.
 *
 * The acceleration itself is ours: benchmarks/kernels.py writes panda_body.h from the generator's
 * program, with what hangs on the configuration alone (533 flops of 1,220, and all six sines and
 * cosines) apart from what needs the velocities. Around it, by hand:
 *
 * - stages 1 and 2 have their configurations from the start, q and q + h/2 qd; those of 3 and 4 are
 *   both known once a2 is. So configurations are worked out two at a time, in a vector's lanes.
 * - sines and cosines of both in vectors of four; those of stages 3 and 4 turned from stage 2's by
 *   h^2/4 a1 and h/2 qd + h^2/2 a2, as csrc/sincos/incremental.h does.
 *
 * That brought 1,016 to 712 ns a step with nothing else running, turning 2 % more. No gain:
 * statements reordered by list scheduling (more spills), gcc's scheduling before register
 * allocation, vectorising straight-line code, both functions inlined (slower), -O1, -O2. Of some
 * 2,250 cycles a step 2 times 280 go into the configurations and 4 times 330 into the rest,
 * dependent on one another or not. clang's is 4 % faster than gcc's.
 *
 * No pivot is checked here, nor whether the state is finite; ours does both.
 */
#include "lanes.h"

typedef double pair __attribute__((vector_size(16), may_alias));

#include "panda_body.h"

enum { NQ = 7, ANGLES = 2*(NQ - 1) };

/* Of joints 2 to 7, stages in turns. */
typedef double angles[ANGLES] __attribute__((aligned(32)));

/* s, c = sin x, cos x */
INLINE void sincos_of(angles s, angles c, const angles x)
{
    for (int i = 0; i < ANGLES; i += 4) {
        const v4 at = _mm256_load_pd(x + i), size = _mm256_andnot_pd(ALL4(-0.0), at);
        const int wide = _mm256_movemask_pd(_mm256_cmp_pd(size, ALL4(LIMIT), _CMP_NLE_UQ));
        v4 sines, cosines;

        sincos4(at, &sines, &cosines, 1);
        _mm256_store_pd(s + i, sines);
        _mm256_store_pd(c + i, cosines);
        for (int j = i; wide >> (j - i); j++)
            eomc_sincos(x[j], s + j, c + j);
    }
}

/* s, c = those of the later stage in s2, c2, turned by d; zero where some d is too large for it. */
INLINE int turned(angles s, angles c, const angles s2, const angles c2, const angles d)
{
    v4 far = ALL4(0.0);

    for (int i = 0; i < ANGLES; i += 4) {
        const v4 x = _mm256_load_pd(d + i), z = x*x, size = _mm256_andnot_pd(ALL4(-0.0), x);
        const v4 s0 = _mm256_permute_pd(_mm256_load_pd(s2 + i), 15);
        const v4 c0 = _mm256_permute_pd(_mm256_load_pd(c2 + i), 15);
        const v4 a = mad4(z, ALL4(0.008333284892876857), ALL4(-0.1666666666651884));
        const v4 b = mad4(z, ALL4(-0.0013888828338282364), ALL4(0.04166666666648188));
        const v4 sin_d = mad4(x*z, a, x), less = z*mad4(z, b, ALL4(-0.5));

        _mm256_store_pd(s + i, mad4(c0, sin_d, mad4(s0, less, s0)));
        _mm256_store_pd(c + i, nmad4(s0, sin_d, mad4(c0, less, c0)));
        far = _mm256_or_pd(far, _mm256_cmp_pd(size, ALL4(0x1p-6), _CMP_NLE_UQ));
    }
    return !_mm256_movemask_pd(far);
}

/* kept[k]: what the velocities need, of both stages. */
static __attribute__((noinline)) void configurations(pair *restrict kept, const angles s,
    const angles c)
{
    const pair *const sine = (const pair *)s, *const cosine = (const pair *)c;
    PANDA_CONFIGURATION
}

/* a = qdd; kept: of one stage, every other number. */
static __attribute__((noinline)) void accelerate(double *restrict a, const double *restrict kept,
    const double *restrict qd, const double *restrict u)
{
    PANDA_ACCELERATION
}

/* to + more; what is lost to rounding goes into the next sum (Kahan), as in ours. */
INLINE void add(double *to, double *lost, double more)
{
    const double y = more + *lost, then = *to + y;

    *lost = (*to - then) + y;
    *to = then;
}

/* x = [q; qd] after so many steps of h, in place. */
void kernel_run(double x[2*NQ], double h, long steps)
{
    const double h_2 = 0.5*h, h_6 = h/6, hh_4 = h_2*h_2, hh_2 = h*h_2, hh_6 = h*h_6;
    const double u[NQ] = { 0 };
    double *const q = x, *const qd = x + NQ;
    angles x12, s12, c12, d, x34, s34, c34;
    double q_lost[NQ] = { 0 }, qd_lost[NQ] = { 0 }, v[NQ], a1[NQ], a2[NQ], a3[NQ], a4[NQ];
    pair kept[PANDA_KEPT];
    const double *const first = (const double *)kept, *const second = first + 1;

    for (long n = 0; n < steps; n++) {
        for (int i = 1; i < NQ; i++) {
            x12[2*i - 2] = q[i];
            x12[2*i - 1] = q[i] + h_2*qd[i];
        }
        sincos_of(s12, c12, x12);
        configurations(kept, s12, c12);
        accelerate(a1, first, qd, u);
        for (int i = 0; i < NQ; i++)
            v[i] = qd[i] + h_2*a1[i];
        accelerate(a2, second, v, u);
        for (int i = 1; i < NQ; i++) {
            d[2*i - 2] = hh_4*a1[i];
            d[2*i - 1] = h_2*qd[i] + hh_2*a2[i];
        }
        if (!turned(s34, c34, s12, c12, d)) {
            for (int i = 0; i < ANGLES; i++)
                x34[i] = x12[i | 1] + d[i];
            sincos_of(s34, c34, x34);
        }
        configurations(kept, s34, c34);
        for (int i = 0; i < NQ; i++)
            v[i] = qd[i] + h_2*a2[i];
        accelerate(a3, first, v, u);
        for (int i = 0; i < NQ; i++)
            v[i] = qd[i] + h*a3[i];
        accelerate(a4, second, v, u);
        for (int i = 0; i < NQ; i++) {
            add(q + i, q_lost + i, h*qd[i] + hh_6*(a1[i] + a2[i] + a3[i]));
            add(qd + i, qd_lost + i, h_6*((a1[i] + a4[i]) + 2.0*(a2[i] + a3[i])));
        }
    }
}
