/*
 * Sines and cosines near two predicted angles: of the middle and of the end of a step.
 *
 * The angles of a step lie within some h^2 a of
 *
 *     x + t x' + t^2/2 x'',   t = 3/2 h and 2 h,   x, x' and x'' one step before
 * (of the first step t = h/2 and h, from its start),
 *
 * so the sines and cosines of these two are computed early, in one vector register, and those of
 * the stages are rotated from there by the distance d:
 *
 *     sin(x + d) = s + d c - d^2/2 (s + d c/3)
 *     cos(x + d) = c - d s - d^2/2 (c - d s/3)
 *
 * Error: at the predicted angles, |x| <= 2^20, at most 2^-53, and 1.7 2^-53 in all where
 * d <= 2^-12: the term left out, d^4/24, is mostly made good by a half that is a little less.
 *
 * far: halves of the squares of d are added to it, and as much as 2^-25 for |x| = 2^20; a sum of at
 * most that is close enough. A NaN stays in it.
 */
#ifdef __GNUC__
typedef double eomc_two __attribute__((vector_size(16)));
typedef unsigned long long eomc_bits __attribute__((vector_size(16)));
#else
typedef double eomc_two[2];
#endif

typedef struct {
    eomc_two x, s, c;
} eomc_predicted;

/* s, c and their thirds: what a rotation takes. */
typedef struct {
    double s, c, s_3, c_3;
} eomc_predicted_terms;

/* f->x: of an angle x with the derivatives v and a, at the times mid and end from now. */
EOMC_INLINE void eomc_predict(eomc_predicted *f,
    double x, double v, double a, double mid, double end)
{
    const eomc_two on = { mid, end }, bent = { 0.5 * mid * mid, 0.5 * end * end };

#ifdef __GNUC__
    f->x = (x + v * on) + a * bent;
#else
    for (int i = 0; i < 2; i++)
        f->x[i] = (x + v * on[i]) + a * bent[i];
#endif
}

/* At f->x, as eomc_sincos_small, but for the last digits of the smallest sines. */
EOMC_INLINE void eomc_predicted_sincos(eomc_predicted *f)
{
#ifdef __GNUC__
    const double magic = 6755399441055744.0;
    const eomc_two x = f->x, shifted = x * 0.6366197723675814 + magic;
    const eomc_two n = shifted - magic;

    /* pi/2 in parts, of 33 bits the first: its products are exact, whether contracted or not */
    const eomc_two r = (x - n * 1.5707963267341256) - n * 6.077100506506192e-11;
    const eomc_two z = r * r, r3 = r * z;
    const eomc_two p45 = z * 1.5895433185809817e-10 + -2.505073438811647e-08;
    const eomc_two p23 = (p45 * z + 2.755731353851118e-06) * z + -0.00019841269829358528;
    const eomc_two p = (p23 * z + 0.00833333333332184) * z + -0.1666666666666663;
    const eomc_two q45 = z * -1.1358749082675865e-11 + 2.0875705393755688e-09;
    const eomc_two q23 = (q45 * z + -2.755731421702807e-07) * z + 2.4801587289002062e-05;
    const eomc_two q = (q23 * z + -0.0013888888888873342) * z + 0.041666666666666595;
    const eomc_bits sin_r = (eomc_bits)(r3 * p + r);
    const eomc_bits cos_r = (eomc_bits)(z * (z * q + -0.5) + 1.0);

    /* the last bits of the sum are those of the integer: odd swaps sine and cosine */
    const eomc_bits m = (eomc_bits)shifted, odd = -(m & 1);
    const eomc_bits swap = (sin_r ^ cos_r) & odd;
    const eomc_bits minus = (m >> 1) << 63;

    f->s = (eomc_two)(sin_r ^ swap ^ minus);
    f->c = (eomc_two)(cos_r ^ swap ^ minus ^ (m << 63));
#else
    for (int i = 0; i < 2; i++)
        eomc_sincos_small(f->x[i], &f->s[i], &f->c[i]);
#endif
}

EOMC_INLINE void eomc_predicted_unpack(eomc_predicted_terms *mid,
    eomc_predicted_terms *end, const eomc_predicted *f, double *far)
{
#ifdef __GNUC__
    const eomc_two s_3 = f->s * (1.0 / 3.0), c_3 = f->c * (1.0 / 3.0);
#else
    const eomc_two s_3 = { f->s[0] * (1.0 / 3.0), f->s[1] * (1.0 / 3.0) };
    const eomc_two c_3 = { f->c[0] * (1.0 / 3.0), f->c[1] * (1.0 / 3.0) };
#endif

    mid->s = f->s[0], mid->c = f->c[0], mid->s_3 = s_3[0], mid->c_3 = c_3[0];
    end->s = f->s[1], end->c = f->c[1], end->s_3 = s_3[1], end->c_3 = c_3[1];
    *far += f->x[1] * 2.710505431213761e-20 * f->x[1];
}

/* s, c at the distance d from a predicted angle. */
EOMC_INLINE void eomc_predicted_rotate(
    double d, const eomc_predicted_terms *k, double *s, double *c, double *far)
{
    const double z = 0.4999999979425627 * d * d;

    *s = (k->s + d * k->c) - z * (k->s + d * k->c_3);
    *c = (k->c - d * k->s) - z * (k->c - d * k->s_3);
    *far += z;
}

EOMC_INLINE int eomc_predicted_close(double far)
{
    return far <= 2.98023223876953125e-08;
}
