/* An iteration over the stages of a step of a Gauss method. */

/* Accelerations at the stages of a step. */
typedef struct {
    real x[EOM_NQ][EOM_GAUSS_STAGES];
} eom_gauss_stages;

/*
 * b = the accelerations at the stages to which the accelerations a lead. Returns 0 if some do not exist.
#if EOM_CONSTRAINTS
 * project: whether the stages are projected onto the constraints first: towards singular positions, velocity
 * errors across the constraints would change accelerations without bound.
#endif
 */
#if EOM_CONSTRAINTS
static int eom_gauss_sweep(eom_gauss_stages *b, const eom_gauss_stages *a, const real *q, const real *qd, real t, real h, int project, const eom_model *m)
#else
static int eom_gauss_sweep(eom_gauss_stages *b, const eom_gauss_stages *a, const real *q, const real *qd, real t, real h, const eom_model *m)
#endif
{
    enum { S = EOM_GAUSS_STAGES, NQ = EOM_NQ };
    int good = 1;

    for (int i = 0; i < S; i++) {
        real r[NQ], v[NQ], f[NQ];

        for (int k = 0; k < NQ; k++) {
            real of_q = 0, of_qd = 0;

            for (int j = 0; j < S; j++) {
                of_q += eom_gauss_AA[i][j]*a->x[k][j];
                of_qd += eom_gauss_A[i][j]*a->x[k][j];
            }
            r[k] = q[k] + h*(eom_gauss_c[i]*qd[k] + h*of_q);
            v[k] = qd[k] + h*of_qd;
        }
#if EOM_CONSTRAINTS
        good = !(project && eom_project_stage(r, v, t + eom_gauss_c[i]*h, m)) && good;
#endif
        good = eom_accelerate(f, r, v, t + eom_gauss_c[i]*h, m) == EOM_OK && good;
        for (int k = 0; good && k < NQ; k++)
            b->x[k][i] = f[k];
    }
    return good;
}
