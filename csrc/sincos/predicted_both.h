/* eomc_predicted_sincos for two, to the same bits, in registers twice as wide if there are any. */
EOMC_INLINE void eomc_predicted_both(
    eomc_predicted *f, eomc_predicted *g)
{
#ifdef __GNUC__
    typedef double eomc_four __attribute__((vector_size(32)));
    typedef unsigned long long eomc_bits_4 __attribute__((vector_size(32)));
    const double magic = 6755399441055744.0;
    const eomc_four x = { f->x[0], f->x[1], g->x[0], g->x[1] };
    const eomc_four shifted = x * 0.6366197723675814 + magic, n = shifted - magic;
    const eomc_four r = (x - n * 1.5707963267341256) - n * 6.077100506506192e-11;
    const eomc_four z = r * r, r3 = r * z;
    const eomc_four p45 = z * 1.5895433185809817e-10 + -2.505073438811647e-08;
    const eomc_four p23 = (p45 * z + 2.755731353851118e-06) * z + -0.00019841269829358528;
    const eomc_four p = (p23 * z + 0.00833333333332184) * z + -0.1666666666666663;
    const eomc_four q45 = z * -1.1358749082675865e-11 + 2.0875705393755688e-09;
    const eomc_four q23 = (q45 * z + -2.755731421702807e-07) * z + 2.4801587289002062e-05;
    const eomc_four q = (q23 * z + -0.0013888888888873342) * z + 0.041666666666666595;
    const eomc_bits_4 sin_r = (eomc_bits_4)(r3 * p + r);
    const eomc_bits_4 cos_r = (eomc_bits_4)(z * (z * q + -0.5) + 1.0);
    const eomc_bits_4 m = (eomc_bits_4)shifted, odd = -(m & 1);
    const eomc_bits_4 swap = (sin_r ^ cos_r) & odd;
    const eomc_bits_4 minus = (m >> 1) << 63;
    const eomc_four s = (eomc_four)(sin_r ^ swap ^ minus);
    const eomc_four c = (eomc_four)(cos_r ^ swap ^ minus ^ (m << 63));
    const eomc_two s_f = { s[0], s[1] }, s_g = { s[2], s[3] };
    const eomc_two c_f = { c[0], c[1] }, c_g = { c[2], c[3] };

    f->s = s_f, f->c = c_f;
    g->s = s_g, g->c = c_g;
#else
    eomc_predicted_sincos(f);
    eomc_predicted_sincos(g);
#endif
}
