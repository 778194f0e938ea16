/*
 * Exponential function of a lane in single precision, without a branch, of any argument: exp.h for
 * float.
 *
 * Error: below 0.9 ulp; P is off by 2^-30 at most.
 */
#ifdef __ASSOCIATIVE_MATH__
#error "-fassociative-math breaks the reduction of exponents: compile without it"
#endif
#if defined __FLT_EVAL_METHOD__ && (__FLT_EVAL_METHOD__ == 1 || __FLT_EVAL_METHOD__ == 2)
#error "needs sums rounded to float, nothing wider: on 32-bit x86 use -msse2 -mfpmath=sse"
#endif

/* e^r in [0.70, 1.42] of x, |x| <= 105; the last bits of shifted are those of the integer n. */
EOMC_INLINE eomc_LANE eomc_exp_reduced_LANE(eomc_LANE x, eomc_LANE *shifted)
{
    const float magic = 12582912.0f; /* 1.5 2^23: adding it rounds to an integer */
    const eomc_LANE rounded = x*1.442695f + magic, n = rounded - magic;

    /* r and what it lost: the first part of ln 2 has 15 bits, its product with n is exact,
     * whether compilers contract it or not */
    const eomc_LANE above = x - n*0.69314575f, r = above - n*1.4286068e-06f;
    const eomc_LANE remainder = (above - r) - n*1.4286068e-06f;

    const eomc_LANE z = r*r;
    const eomc_LANE p01 = r*0.16666667f + 0.5f, p23 = r*0.0083333105f + 0.041666467f;
    const eomc_LANE p45 = r*0.00019890988f + 0.0013933647f;

    *shifted = rounded;
    return (z*(z*(z*p45 + p23) + p01) + remainder + r) + 1.0f;
}

/* e^x. Infinity from 88.73 on, 0 below -103.98. */
EOMC_INLINE eomc_LANE eomc_exp_LANE(eomc_LANE x)
{
    typedef unsigned bits_LANE __attribute__((vector_size(EOMC_LANE_BYTES)));
    const eomc_LANE most = eomc_same_LANE(89.0f), least = eomc_same_LANE(-105.0f);
    eomc_LANE shifted;
    const eomc_LANE y = eomc_exp_reduced_LANE(
        eomc_larger_LANE(least, eomc_smaller_LANE(most, x)), &shifted);

    /* times 2^n in two halves: only the second product can be rounded, or overflow */
    const eomc_LANE middle = (shifted - 12582912.0f)*0.5f + 12582912.0f;
    const bits_LANE half = (bits_LANE)middle, rest = (bits_LANE)shifted - half;
    const bits_LANE one = (bits_LANE)eomc_same_LANE(1.0f);

    return y*(eomc_LANE)((half << 23) + one)*(eomc_LANE)((rest << 23) + one);
}
