/* Derivatives of the accelerations by finite differences. */

/*
 * derivatives = [da/dq, da/dqd], (nq, 2 nq), by forward differences, with inputs by the scene's signals where
 * they are computed. Only the speed of Newton's method depends on their accuracy.
 */
static eom_status eom_differentiate(real *derivatives, const real *q, const real *qd, real t, const eom_model *m)
{
    enum { NQ = EOM_NQ };
    static const real WIDTH = EOM_SQRT_EPS; /* balances errors of rounding and truncation */
    real x[2*NQ], here[NQ], near[NQ];
    eom_status status;

    for (int i = 0; i < NQ; i++) {
        x[i] = q[i];
        x[NQ + i] = qd[i];
    }
    status = eom_accelerate(here, q, qd, t, m);
    for (int j = 0; j < 2*NQ && status == EOM_OK; j++) {
        const real value = x[j], step = WIDTH*(eom_fabs(value) + 1);

        x[j] = value + step;
        status = eom_accelerate(near, x, x + NQ, t, m);
        for (int i = 0; i < NQ && status == EOM_OK; i++)
            derivatives[2*NQ*i + j] = (near[i] - here[i])/step;
        x[j] = value;
    }
    return status;
}
