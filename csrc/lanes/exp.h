/*
 * Exponential function of a lane, without a branch, of any argument.
 *
 *     e^x = 2^n e^r,   x = n ln 2 + r,   |r| <= ln(2)/2,   e^r = 1 + r + r^2 P(r)
 *
 * Error: below 0.9 ulp. ln 2 is in two parts (Cody & Waite, Software Manual for the Elementary
 * Functions, 1980, chapter 6). P is a Chebyshev series in r, cut off; that is off by 2^-61 at most.
 */
#ifdef __ASSOCIATIVE_MATH__
#error "-fassociative-math breaks the reduction of exponents: compile without it"
#endif
#if defined __FLT_EVAL_METHOD__ && __FLT_EVAL_METHOD__ == 2
#error "needs sums rounded to double, nothing wider: on 32-bit x86 use -msse2 -mfpmath=sse"
#endif

/* e^r in [0.70, 1.42] of x, |x| <= 750; the last bits of shifted are those of the integer n. */
EOMC_INLINE eomc_LANE eomc_exp_reduced_LANE(eomc_LANE x, eomc_LANE *shifted)
{
    const double magic = 6755399441055744.0; /* 1.5 2^52: adding it rounds to an integer */
    const eomc_LANE rounded = x*1.4426950408889634 + magic, n = rounded - magic;

    /* r and what it lost: the first part of ln 2 has 41 bits, its product with n is exact,
     * whether compilers contract it or not */
    const eomc_LANE above = x - n*0.693147180559663, r = above - n*2.8235290563031577e-13;
    const eomc_LANE remainder = (above - r) - n*2.8235290563031577e-13;

    const eomc_LANE z = r*r, z2 = z*z;
    const eomc_LANE p01 = r*0.1666666666666667 + 0.5;
    const eomc_LANE p23 = r*0.008333333333326136 + 0.04166666666666667;
    const eomc_LANE p45 = r*0.00019841269874815834 + 0.001388888888888375;
    const eomc_LANE p67 = r*2.7557255406285044e-06 + 2.480158732554432e-05;
    const eomc_LANE p89 = r*2.5105214474751413e-08 + 2.7557273647451087e-07;
    const eomc_LANE p03 = z*p23 + p01, p47 = z*p67 + p45;
    const eomc_LANE p8 = z*2.0914685161418067e-09 + p89;
    const eomc_LANE p = z2*(z2*p8 + p47) + p03;

    *shifted = rounded;
    return (z*p + remainder + r) + 1.0;
}

/* e^x. Infinity from 709.79 on, 0 below -745.2. */
EOMC_INLINE eomc_LANE eomc_exp_LANE(eomc_LANE x)
{
    typedef unsigned long long bits_LANE __attribute__((vector_size(EOMC_LANE_BYTES)));
    const eomc_LANE most = eomc_same_LANE(710.0), least = eomc_same_LANE(-746.0);
    eomc_LANE shifted;
    const eomc_LANE y = eomc_exp_reduced_LANE(
        eomc_larger_LANE(least, eomc_smaller_LANE(most, x)), &shifted);

    /* times 2^n in two halves: only the second product can be rounded, or overflow */
    const eomc_LANE middle = (shifted - 6755399441055744.0)*0.5 + 6755399441055744.0;
    const bits_LANE half = (bits_LANE)middle, rest = (bits_LANE)shifted - half;
    const bits_LANE one = (bits_LANE)eomc_same_LANE(1.0);

    return y*(eomc_LANE)((half << 52) + one)*(eomc_LANE)((rest << 52) + one);
}
