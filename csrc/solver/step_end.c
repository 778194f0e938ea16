/* The stages and the end of a step of a Runge-Kutta method for second-order equations. */

/*
 * r, v = position and velocity at stage i, from the accelerations a at the first stages: those before i of an explicit
 * method, all of an implicit one.
 */
static void eom_method_stage_state(real *r, real *v, const real *a, int i, int count, const real *q, const real *qd, real h)
{
    enum { NQ = EOM_NQ };
    const real *const A = eom_method_A[i], *const AA = eom_method_AA[i];

    for (int k = 0; k < NQ; k++) {
        real of_q = 0, of_qd = 0;

        for (int j = 0; j < count; j++) {
            of_q += AA[j]*a[NQ*j + k];
            of_qd += A[j]*a[NQ*j + k];
        }
        r[k] = q[k] + h*(eom_method_c[i]*qd[k] + h*of_q);
        v[k] = qd[k] + h*of_qd;
    }
}

/* r, v = the state at the end of a step with the accelerations a at its stages. */
static void eom_method_end_state(real *r, real *v, const real *a, const real *q, const real *qd, real h)
{
    enum { S = EOM_METHOD_STAGES, NQ = EOM_NQ };

    for (int k = 0; k < NQ; k++) {
        real of_q = 0, of_qd = 0;

        for (int j = 0; j < S; j++) {
            of_q += eom_method_bA[j]*a[NQ*j + k];
            of_qd += eom_method_b[j]*a[NQ*j + k];
        }
        r[k] = q[k] + h*(qd[k] + h*of_q);
        v[k] = qd[k] + h*of_qd;
    }
}
