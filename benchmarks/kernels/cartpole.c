/*
 * Classical RK4 of the cart-pole of scenes/cartpole.toml, by hand: the limit for the generator.
 *
 *     theta'' = A - B theta'^2,  A = w5 sin/D,  B = w7 sin/D,  w7 = k cos,  D = 1 - k cos^2
 *     x''     = w6 (cos theta'' - sin theta'^2)
 *
 * D, w5 and k are divided by the inertia about the pivot; k <= 3/4, so that D >= 1/4.
 * benchmarks/kernels.py compiles, checks and times this file.
 */
#include "lanes.h"

typedef struct {
    double k, w5, w6;
} prepared;

static prepared prepare(const double p[4])
{
    const double m_c = p[0], m_p = p[1], l = p[2], g = p[3], inertia = l*l*m_p/3;
    const double w1 = l*m_p, w3 = w1/(m_c + m_p);

    return (prepared){ 0.25*w1*w3/inertia, 0.5*g*w1/inertia, 0.5*w3 };
}

/* What the sums have lost to rounding goes into the next ones (Kahan), as in ours. */
typedef struct {
    double x, theta, vx, w;
} state;

INLINE double add(double *lost, double sum, double more)
{
    const double y = more + *lost, then = sum + y;

    *lost = (sum - then) + y;
    return then;
}

/* a = theta'', b = x''/w6 at an angle from nowhere near a known one. */
INLINE void accelerate(double *a, double *b, double theta, double w, const prepared *p)
{
    double s, c;

    eomc_sincos(theta, &s, &c);
    *a = s*(p->w5 - p->k*c*w*w)/(1.0 - p->k*c*c);
    *b = c**a - s*w*w;
}

/* One step with four sines and cosines in full, for whatever the fast ways refuse. */
static state plain_step(state at, state *lost, double h, const prepared *p)
{
    const double h_2 = 0.5*h, middle = at.theta + h_2*at.w, end = at.theta + h*at.w;
    double a1, a2, a3, a4, b1, b2, b3, b4;

    accelerate(&a1, &b1, at.theta, at.w, p);
    accelerate(&a2, &b2, middle, at.w + h_2*a1, p);
    accelerate(&a3, &b3, middle + h_2*h_2*a1, at.w + h_2*a2, p);
    accelerate(&a4, &b4, end + h*h_2*a2, at.w + h*a3, p);
    at.x = add(&lost->x, at.x, h*at.vx + h*h/6*p->w6*(b1 + b2 + b3));
    at.vx = add(&lost->vx, at.vx, h/6*p->w6*(b1 + b4 + 2.0*(b2 + b3)));
    at.theta = add(&lost->theta, at.theta, h*at.w + h*h/6*(a1 + a2 + a3));
    at.w = add(&lost->w, at.w, h/6*(a1 + a4 + 2.0*(a2 + a3)));
    return at;
}

/*
 * --- One trajectory: bound by latency, and by the 256 instructions that the processor looks ahead.
 *
 * All four stages lie within h^2 theta'' of two angles that can be foretold: the middle and the end
 * of the step. There A, B, cos and sin are expanded in powers of the distance d, ahead of time and
 * off the chain; a stage is then a cubic in d, 25 cycles instead of 70. Three things go on at once
 * in an iteration: the stages of this step; the expansions for the next one, from sines taken in
 * the iteration before; and, last in the program, the sines for the one after it, at angles that
 * are known since the step began. In this order nothing waits at the head of the window.
 *
 * In cycles a step, by gcc and clang (generated: 192; four sines in full, by hand: 208, 188):
 *     stages 3, 4 and the next 1 turned from two angles, their sines at the step's start 185  157
 *     the two angles foretold, their sines a step ahead and last in the program          136  113
 *     turned by s + d (c - d (s/2 + d c/6)), not by s + (c sin d + s (cos d - 1))        103  107
 *     series instead of turning, sines and expansions together in front                  149  151
 *     the expansions in front, the sines last; powers to d^4                             121   98
 *     powers to d^3                                                                      111   89
 *     compensated sums and checks, as below                                              102  103
 * Good for short steps: where h^2 theta'' is above 2^-10 or so, all steps are plain ones.
 */

/* A and cos, B and sin about one angle, in powers of d. */
typedef struct {
    v4 power[4];
} series;

/* Beyond it a step is taken plainly: d^4 is 2^-52 there, times 11 in A at k = 3/4. */
static const double NEAR = 0x1p-13;

INLINE v4 join(v2 low, v2 high)
{
    return _mm256_insertf128_pd(_mm256_castpd128_pd256(low), high, 1);
}

INLINE void sincos2(v2 x, v2 *s, v2 *c)
{
    v4 wide_s, wide_c;

    sincos4(_mm256_zextpd128_pd256(x), &wide_s, &wide_c, 1);
    *s = _mm256_castpd256_pd128(wide_s);
    *c = _mm256_castpd256_pd128(wide_c);
}

/*
 * The series about two angles from their sines and cosines. A = N/D power by power:
 * A_n = (N_n - D_1 A_{n-1} - ... - D_n A_0)/D_0, with D_0 divided out before.
 */
INLINE void expand(series *first, series *second, v2 s, v2 c, const prepared *p)
{
    const v2 k = ALL2(p->k), inv = ALL2(1.0)/nmad2(k*c, c, ALL2(1.0));
    const v2 w5 = ALL2(p->w5)*inv, k_inv = k*inv, half = k_inv*(s*c);
    const v2 d1 = half + half, d2 = k_inv*(c*c - s*s);
    const v4 n0 = join(w5*s, half), n1 = join(w5*c, d2);
    const v4 n2 = n0*_mm256_setr_pd(-0.5, -0.5, -2.0, -2.0);
    const v4 n3 = n1*_mm256_setr_pd(-1.0/6, -1.0/6, -2.0/3, -2.0/3);
    const v4 D1 = join(d1, d1), D2 = join(d2, d2), D3 = D1*ALL4(-2.0/3);
    const v4 a0 = n0, a1 = nmad4(D1, a0, n1), a2 = nmad4(D1, a1, nmad4(D2, a0, n2));
    const v4 a3 = nmad4(D1, a2, nmad4(D2, a1, nmad4(D3, a0, n3)));
    const v4 c0 = join(c, s), c1 = join(-s, c), c2 = c0*ALL4(-0.5), c3 = c1*ALL4(-1.0/6);

    first->power[0] = _mm256_unpacklo_pd(a0, c0);
    first->power[1] = _mm256_unpacklo_pd(a1, c1);
    first->power[2] = _mm256_unpacklo_pd(a2, c2);
    first->power[3] = _mm256_unpacklo_pd(a3, c3);
    second->power[0] = _mm256_unpackhi_pd(a0, c0);
    second->power[1] = _mm256_unpackhi_pd(a1, c1);
    second->power[2] = _mm256_unpackhi_pd(a2, c2);
    second->power[3] = _mm256_unpackhi_pd(a3, c3);
}

/* a = theta'', b = x''/w6 at the distance d from the angle of the series. */
INLINE void stage(double *a, double *b, const series *about, double d, double w)
{
    const v4 D = _mm256_broadcastsd_pd(_mm_set_sd(d));
    const v4 *const power = about->power;
    const v4 v = mad4(D*D, mad4(D, power[3], power[2]), mad4(D, power[1], power[0]));
    const v2 a_cos = _mm256_castpd256_pd128(v), b_sin = _mm256_extractf128_pd(v, 1);
    const v2 square = ALL2(w*w), turned = b_sin*square, both = nmad2(b_sin, square, a_cos);

    *a = _mm_cvtsd_f64(both);
    *b = fma(_mm_cvtsd_f64(_mm_unpackhi_pd(a_cos, a_cos)), *a,
        -_mm_cvtsd_f64(_mm_unpackhi_pd(turned, turned)));
}

/* Steps until one leaves the bounds, which is not taken; their number. */
static long near_steps(state *at, state *last_lost, double h, long steps, const prepared *p)
{
    const double h_2 = 0.5*h, h_6 = h/6, hh_4 = h_2*h_2, hh_2 = h*h_2, hh_6 = h*h_6;
    const double x_6 = hh_6*p->w6, vx_6 = h_6*p->w6;
    const v2 two_on = _mm_setr_pd(2.5*h, 3*h), fallen = _mm_setr_pd(3.125*h*h, 4.5*h*h);
    double x = at->x, theta = at->theta, vx = at->vx, w = at->w, d1 = 0, before, unused;
    state lost = *last_lost;
    series store[5], *begin = store, *middle = store + 1, *end = store + 2;
    series *next_middle = store + 3, *next_end = store + 4;
    v2 now = _mm_setr_pd(theta + h_2*w, theta + h*w), next, s, c;
    long n;

    accelerate(&before, &unused, theta, w, p);
    next = _mm_setr_pd(theta + 1.5*h*w + 1.125*h*h*before, theta + 2*h*w + 2*h*h*before);
    sincos2(ALL2(theta), &s, &c);
    expand(begin, middle, s, c, p);
    sincos2(now, &s, &c);
    expand(middle, end, s, c, p);
    sincos2(next, &s, &c);
    for (n = 0; n < steps; n++) {
        const double hw = h*w;
        const v2 after_next = mad2(fallen, ALL2(before), mad2(two_on, ALL2(w), ALL2(theta)));
        const double foretold_end = _mm_cvtsd_f64(_mm_unpackhi_pd(now, now));
        const double to_end = (theta - foretold_end) + (hw + lost.theta);
        const double d2 = (theta - _mm_cvtsd_f64(now)) + fma(h_2, w, lost.theta);
        double a1, a2, a3, a4, b1, b2, b3, b4;

        expand(next_middle, next_end, s, c, p);
        stage(&a1, &b1, begin, d1, w);
        stage(&a2, &b2, middle, d2, fma(h_2, a1, w));
        const double d3 = fma(hh_4, a1, d2), d4 = fma(hh_2, a2, to_end);
        stage(&a3, &b3, middle, d3, fma(h_2, a2, w));
        stage(&a4, &b4, end, d4, fma(h, a3, w));
        sincos2(after_next, &s, &c);
        const v4 far = _mm256_andnot_pd(ALL4(-0.0), _mm256_setr_pd(d1, d2, d3, d4));
        if (_mm256_movemask_pd(_mm256_cmp_pd(far, ALL4(NEAR), _CMP_NLE_UQ))
            || !(fabs(theta) + fabs(3*hw) <= LIMIT))
            break;
        const double a23 = a2 + a3, sum = a1 + a23;
        x = add(&lost.x, x, fma(x_6, b1 + b2 + b3, h*vx));
        vx = add(&lost.vx, vx, vx_6*((b1 + b4) + 2.0*(b2 + b3)));
        d1 = fma(hh_6, sum, to_end); /* not from the rounded theta, which would come later */
        theta = add(&lost.theta, theta, fma(hh_6, sum, hw));
        w = add(&lost.w, w, h_6*fma(2.0, a23, a1 + a4));
        before = a4;
        series *const free_end = begin, *const free_middle = middle;
        begin = end, end = next_end, next_end = free_end;
        middle = next_middle, next_middle = free_middle;
        now = next;
        next = after_next;
    }
    *at = (state){ x, theta, vx, w };
    *last_lost = lost;
    return n;
}

/* x = [q; qd] after so many steps of h, in place; p: m_c, m_p, l, g. */
void kernel_run(double x[4], double h, long steps, const double p[4])
{
    const prepared prepared = prepare(p);
    state at = { x[0], x[1], x[2], x[3] }, lost = { 0, 0, 0, 0 };

    while (steps > 0) {
        steps -= near_steps(&at, &lost, h, steps, &prepared);
        /* to begin again costs as much as five plain steps */
        for (int k = 0; k < 16 && steps > 0; k++, steps--)
            at = plain_step(at, &lost, h, &prepared);
    }
    memcpy(x, &at, sizeof at);
}

/*
 * --- Many trajectories: bound by the number of operations, if enough of them are in flight.
 *
 * The step of a vector is a chain of 350 cycles in 200 instructions: the window holds one. So a
 * step goes through a tile of vectors stage by stage, what lies between in the first-level cache.
 * Only the middle angle has its sine and cosine in full; theta and the end are delta = h/2 theta'
 * away from it on both sides, stages 3 and 4 another h^2/4 a1 and h^2/2 a2.
 *
 * In ns a step and instance, nothing else running: generated 19; tiles of 2, 4, 8, 16 vectors 7.2,
 * 5.7, 5.5, 5.5; with rcpps and Newton for the divisions 7.5; with stage 3's reciprocal by Newton
 * from stage 2's 6.0; with one division for three stages 8. Estrin, sines in a loop of their own
 * and clang: no gain. The four loops take 2.2, 0.9, 1.2 and 1.3.
 */
enum { TILE = 8 };

typedef struct {
    v4 x, theta, vx, w;
} states;

typedef struct {
    v4 k, w5, h, h_2, h_6, hh_2, hh_4, hh_6, x_6, vx_6;
} constants;

/* What the stages of a step hand on; check: a sum of squares that must be at most 2^-10. */
typedef struct {
    v4 s1, c1, s2, c2, s4, c4, middle, delta, check, a1, a2, b1, b2, w4, a123, a1_23, b123, b1_23;
} between;

/* s1, c1: s, c turned by d, d^2 = z <= 2^-24. */
INLINE void turn4(v4 *s1, v4 *c1, v4 s, v4 c, v4 d, v4 z)
{
    const v4 sine = d*mad4(z, ALL4(-1.0/6), ALL4(1.0)), lost = z*ALL4(-0.5);

    *s1 = mad4(c, sine, mad4(s, lost, s));
    *c1 = nmad4(s, sine, mad4(c, lost, c));
}

INLINE void accelerate4(v4 *a, v4 *b, v4 s, v4 c, v4 w, const constants *p)
{
    const v4 w7 = c*p->k, inv = ALL4(1.0)/nmad4(w7, c, ALL4(1.0)), square = w*w;

    *a = s*nmad4(w7, square, p->w5)*inv;
    *b = _mm256_fmsub_pd(c, *a, s*square);
}

/* One step of a tile; nonzero if some lane left the bounds, and refused says which. */
static int tile_step(states *restrict to, const states *restrict from, between *restrict k,
    v4 *restrict refused, const constants *p)
{
    v4 any = ALL4(0.0);

    for (int i = 0; i < TILE; i++) {
        const v4 delta = p->h_2*from[i].w, middle = from[i].theta + delta, z = delta*delta;
        v4 s, c;

        sincos4(middle, &s, &c, 0);
        const v4 tail = mad4(mad4(ALL4(-1.0/5040), z, ALL4(1.0/120)), z, ALL4(-1.0/6));
        const v4 sine = mad4(delta*z, tail, delta);
        const v4 rest = mad4(mad4(ALL4(1.0/40320), z, ALL4(-1.0/720)), z, ALL4(1.0/24));
        const v4 lost = z*mad4(rest, z, ALL4(-0.5));
        const v4 near_s = mad4(s, lost, s), near_c = mad4(c, lost, c);

        k[i].s1 = nmad4(c, sine, near_s), k[i].c1 = mad4(s, sine, near_c);
        k[i].s2 = s, k[i].c2 = c;
        k[i].s4 = mad4(c, sine, near_s), k[i].c4 = nmad4(s, sine, near_c);
        k[i].middle = middle, k[i].delta = delta;
        k[i].check = mad4(middle*middle, ALL4(0x1p-50), z);
    }
    for (int i = 0; i < TILE; i++) {
        accelerate4(&k[i].a1, &k[i].b1, k[i].s1, k[i].c1, from[i].w, p);
        const v4 w2 = mad4(p->h_2, k[i].a1, from[i].w);
        accelerate4(&k[i].a2, &k[i].b2, k[i].s2, k[i].c2, w2, p);
    }
    for (int i = 0; i < TILE; i++) {
        const v4 d = p->hh_4*k[i].a1, z = d*d, w3 = mad4(p->h_2, k[i].a2, from[i].w);
        v4 s, c, a3, b3;

        turn4(&s, &c, k[i].s2, k[i].c2, d, z);
        accelerate4(&a3, &b3, s, c, w3, p);
        const v4 a23 = k[i].a2 + a3, b23 = k[i].b2 + b3;
        k[i].w4 = mad4(p->h, a3, from[i].w);
        k[i].a123 = k[i].a1 + a23, k[i].a1_23 = k[i].a123 + a23;
        k[i].b123 = k[i].b1 + b23, k[i].b1_23 = k[i].b123 + b23;
        k[i].check = mad4(z, ALL4(0x1p14), k[i].check);
    }
    for (int i = 0; i < TILE; i++) {
        const v4 d = p->hh_2*k[i].a2, z = d*d, check = mad4(z, ALL4(0x1p14), k[i].check);
        v4 s, c, a4, b4;

        turn4(&s, &c, k[i].s4, k[i].c4, d, z);
        accelerate4(&a4, &b4, s, c, k[i].w4, p);
        refused[i] = _mm256_cmp_pd(check, ALL4(0x1p-10), _CMP_NLE_UQ);
        any = _mm256_or_pd(any, refused[i]);
        to[i].x = from[i].x + mad4(p->x_6, k[i].b123, p->h*from[i].vx);
        to[i].vx = mad4(p->vx_6, k[i].b1_23 + b4, from[i].vx);
        to[i].theta = k[i].middle + mad4(p->hh_6, k[i].a123, k[i].delta);
        to[i].w = mad4(p->h_6, k[i].a1_23 + a4, from[i].w);
    }
    return _mm256_movemask_pd(any);
}

/* The refused lanes again, one by one. */
static void step_again(states *to, const states *from, const v4 *refused, double h,
    const prepared *p)
{
    for (int i = 0; i < TILE; i++) {
        const int which = _mm256_movemask_pd(refused[i]);

        for (int lane = 0; lane < 4; lane++) {
            if (!(which >> lane & 1))
                continue;
            const state at = { from[i].x[lane], from[i].theta[lane], from[i].vx[lane],
                from[i].w[lane] };
            state lost = { 0, 0, 0, 0 };
            const state then = plain_step(at, &lost, h, p);
            to[i].x[lane] = then.x, to[i].theta[lane] = then.theta;
            to[i].vx[lane] = then.vx, to[i].w[lane] = then.w;
        }
    }
}

/* x: [q; qd] in rows, (4, count), after so many steps of h, in place; p: m_c, m_p, l, g for all. */
void kernel_batch(double *x, double h, long steps, long count, const double p[4])
{
    const prepared prepared = prepare(p);
    const double h_6 = h/6, hh_6 = h*h_6;
    const constants c = { ALL4(prepared.k), ALL4(prepared.w5), ALL4(h), ALL4(0.5*h), ALL4(h_6),
        ALL4(0.5*h*h), ALL4(0.25*h*h), ALL4(hh_6), ALL4(hh_6*prepared.w6),
        ALL4(h_6*prepared.w6) };

    for (long base = 0; base < count; base += 4*TILE) {
        states one[TILE], two[TILE], *from = one, *to = two;
        between k[TILE];
        v4 refused[TILE];

        for (int i = 0; i < TILE; i++) {
            for (int lane = 0; lane < 4; lane++) {
                const long wanted = base + 4*i + lane, at = wanted < count ? wanted : count - 1;

                from[i].x[lane] = x[at], from[i].theta[lane] = x[count + at];
                from[i].vx[lane] = x[2*count + at], from[i].w[lane] = x[3*count + at];
            }
        }
        for (long n = 0; n < steps; n++) {
            if (tile_step(to, from, k, refused, &c))
                step_again(to, from, refused, h, &prepared);
            states *const swap = from;
            from = to, to = swap;
        }
        for (int i = 0; i < TILE; i++) {
            for (int lane = 0; lane < 4 && base + 4*i + lane < count; lane++) {
                const long at = base + 4*i + lane;

                x[at] = from[i].x[lane], x[count + at] = from[i].theta[lane];
                x[2*count + at] = from[i].vx[lane], x[3*count + at] = from[i].w[lane];
            }
        }
    }
}
