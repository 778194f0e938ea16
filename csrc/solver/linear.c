/* Linear systems: LU factorisation with partial pivoting. */

/*
 * P M = L U in place, M (n, n), row[k] the row exchanged with the k-th (Golub & Van Loan, Matrix
 * Computations, alg. 3.4.1). The diagonal of U is stored as reciprocals: those of a singular M are not finite.
 */
static void eom_factor(real *M, int *row, int n)
{
    for (int k = 0; k < n; k++) {
        row[k] = k;
        for (int i = k + 1; i < n; i++)
            if (eom_fabs(M[n*i + k]) > eom_fabs(M[n*row[k] + k]))
                row[k] = i;
        for (int j = 0; row[k] != k && j < n; j++) {
            const real upper = M[n*row[k] + j];

            M[n*row[k] + j] = M[n*k + j];
            M[n*k + j] = upper;
        }
        M[n*k + k] = 1/M[n*k + k];
        for (int i = k + 1; i < n; i++) {
            const real factor = M[n*i + k] *= M[n*k + k];

            for (int j = k + 1; j < n; j++)
                M[n*i + j] -= factor*M[n*k + j];
        }
    }
}

/* x = M^-1 x with the factors of M. */
static void eom_substitute(const real *M, const int *row, real *x, int n)
{
    for (int k = 0; k < n; k++) {
        const real upper = x[row[k]];

        x[row[k]] = x[k];
        x[k] = upper;
    }
    for (int i = 1; i < n; i++)
        for (int j = 0; j < i; j++)
            x[i] -= M[n*i + j]*x[j];
    for (int i = n - 1; i >= 0; i--) {
        for (int j = i + 1; j < n; j++)
            x[i] -= M[n*i + j]*x[j];
        x[i] *= M[n*i + i];
    }
}
