/* Explicit Runge-Kutta methods for second-order equations, from their coefficients. */

/*
 * Advance q, qd by one step of size h. If the status is not OK, they are unchanged.
 *
 * The accelerations a at the stages give the positions q + h c qd + h^2 A A a and velocities qd + h A a
 * (Hairer, Norsett & Wanner, Solving ODEs I, sec. II.14).
 */
#if EOM_CONSTRAINTS
static eom_status eom_explicit_advance(real *q, real *qd, real t, real h, const eom_model *m, int *singular)
#else
static eom_status eom_explicit_advance(real *q, real *qd, real t, real h, const eom_model *m)
#endif
{
    enum { S = EOM_EXPLICIT_STAGES, NQ = EOM_NQ };
    real a[S][NQ], r[NQ], v[NQ];
    eom_status status;

    for (int i = 0; i < S; i++) {
        for (int k = 0; k < NQ; k++) {
            real of_q = 0, of_qd = 0;

            for (int j = 0; j < i; j++) {
                of_q += eom_explicit_AA[i][j]*a[j][k];
                of_qd += eom_explicit_A[i][j]*a[j][k];
            }
            r[k] = q[k] + h*(eom_explicit_c[i]*qd[k] + h*of_q);
            v[k] = qd[k] + h*of_qd;
        }
        status = eom_accelerate(a[i], r, v, t + eom_explicit_c[i]*h, m);
        if (status)
            return status;
    }
    for (int k = 0; k < NQ; k++) {
        real of_q = 0, of_qd = 0;

        for (int j = 0; j < S; j++) {
            of_q += eom_explicit_bA[j]*a[j][k];
            of_qd += eom_explicit_b[j]*a[j][k];
        }
        r[k] = q[k] + h*(qd[k] + h*of_q);
        v[k] = qd[k] + h*of_qd;
    }
#if EOM_CONSTRAINTS
    status = eom_project_end(r, v, q, t + h, m, singular);
    if (status)
        return status;
#endif
    return eom_store_state(q, qd, r, v);
}
