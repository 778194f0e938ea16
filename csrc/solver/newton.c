/* Newton's method for the stages of a step (Hairer & Wanner, Solving ODEs II, sec. IV.8). */

/*
 * The derivatives at q, qd by finite differences, over a part of the change of q, qd in a step of size h plus some
 * rounding errors. The result of the iteration does not depend on their accuracy. Returns 0 on success.
 */
static int eom_jacobian(eom_newton *n, const real *q, const real *qd, real t, real h, const eom_model *m)
{
    enum { NQ = EOM_NQ };
    static const real PART = EOM_SQRT_EPS, ROUNDING = 4096*EOM_EPS; /* of the change in the step; of the value */
    real at_q[EOM_WIDTH] = { 0 }, at_qd[EOM_WIDTH] = { 0 }, here[EOM_WIDTH] = { 0 }, near[EOM_WIDTH] = { 0 }, by[2*NQ], most = 0;

    for (int i = 0; i < NQ; i++) {
        at_q[i] = q[i];
        at_qd[i] = qd[i];
    }
    if (eom_accelerate(here, at_q, at_qd, t, m))
        return 1;
    for (int i = 0; i < NQ; i++) {
        const real gained = eom_fabs(h*here[i]);

        by[i] = PART*(eom_fabs(h*qd[i]) + eom_fabs(h)*gained) + ROUNDING*eom_fabs(q[i]);
        by[NQ + i] = PART*gained + ROUNDING*(eom_fabs(qd[i]) + eom_fabs(q[i]/h));
        most = by[i] > most ? by[i] : most;
        most = by[NQ + i] > most ? by[NQ + i] : most;
    }
    for (int j = 0; j < 2*NQ; j++) {
        real *const moved = j < NQ ? at_q + j : at_qd + (j - NQ);
        const real left = *moved;

        *moved = left + (by[j] > 0 ? by[j] : most > 0 ? most : PART);
        if (eom_accelerate(near, at_q, at_qd, t, m))
            return 1;
        for (int i = 0; i < NQ; i++) {
            n->slopes[2*NQ*i + j] = (near[i] - here[i])/(*moved - left);
            if (!(n->slopes[2*NQ*i + j] - n->slopes[2*NQ*i + j] == 0))
                return 1;
        }
        *moved = left;
    }
    return 0;
}

/* Compute the factors for a step of size h. */
static void eom_factor_newton(eom_newton *n, real h)
{
    enum { NQ = EOM_NQ, N = 2*NQ };

    for (int p = 0; p < EOM_GAUSS_STAGES/2; p++) {
        const real re = h*eom_gauss_eigenvalues[p][0], im = h*eom_gauss_eigenvalues[p][1];
        real *const M = n->lu[p];

        for (int k = 0; k < NQ; k++)
            for (int l = 0; l < NQ; l++) {
                const real of_q = n->slopes[N*k + l], of_qd = n->slopes[N*k + NQ + l];
                const real same = (real)(k == l) - (re*of_qd + (re*re - im*im)*of_q), cross = im*of_qd + 2*re*im*of_q;

                M[N*k + l] = M[N*(NQ + k) + NQ + l] = same;
                M[N*k + NQ + l] = cross;
                M[N*(NQ + k) + l] = -cross;
            }
        eom_factor(M, n->row[p], N);
    }
}

/* b = a + (1 - df/da)^-1 (b - a) in place of b = f(a), by the eigenvectors of A. */
static void eom_newton_correction(eom_gauss_stages *b, const eom_gauss_stages *a, const eom_newton *n)
{
    enum { S = EOM_GAUSS_STAGES, NQ = EOM_NQ };
    real part[S/2][2*NQ];

    for (int k = 0; k < NQ; k++) {
        real d[S];

        for (int i = 0; i < S; i++)
            d[i] = b->x[k][i] - a->x[k][i];
        for (int j = 0; j < S; j++)
            part[j/2][NQ*(j%2) + k] = eom_weighted_sum(eom_gauss_to_parts[j], d);
    }
    for (int p = 0; p < S/2; p++)
        eom_substitute(n->lu[p], n->row[p], part[p], 2*NQ);
    for (int k = 0; k < NQ; k++)
        for (int i = 0; i < S; i++) {
            real sum = 0;

            for (int j = 0; j < S; j++)
                sum += eom_gauss_from_parts[j][i]*part[j/2][NQ*(j%2) + k];
            b->x[k][i] = a->x[k][i] + sum;
        }
}

/* Prepare Newton's method at the start q, qd of a step; x->newton = whether the derivatives exist. */
static void eom_begin_newton(eom_solution *x, const real *q, const real *qd, real t, real h, const eom_model *m, eom_output *output)
{
    output->evaluations += 2*EOM_NQ + 1;
    x->newton = !eom_jacobian(&x->newton_data, q, qd, t, h, m);
}
