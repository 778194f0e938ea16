/* Linear systems, derivatives by finite differences, and copies of states. */
#include "model.h"

#include "check.h"
#include "linear.c"
#include "state.c"
#include "differences.c"

enum { MAX_N = 12 };

/* The factors of a random matrix have L <= 1, and the solution with them has a small residual. */
static void test_random_systems(void)
{
    for (int n = 1; n <= MAX_N; n++)
        for (int repeat = 0; repeat < 20; repeat++) {
            real M[MAX_N*MAX_N], copy[MAX_N*MAX_N], b[MAX_N], x[MAX_N];
            int row[MAX_N];

            for (int i = 0; i < n*n; i++)
                copy[i] = M[i] = (real)draw();
            for (int i = 0; i < n; i++)
                x[i] = b[i] = (real)draw();
            if (n > 1)
                copy[0] = M[0] = repeat % 2 ? EOM_EPS : 0; /* needs an exchange of rows */
            eom_factor(M, row, n);
            for (int i = 0; i < n; i++)
                for (int j = 0; j < i; j++)
                    CHECK(eom_fabs(M[n*i + j]) <= 1, M[n*i + j]);
            eom_substitute(M, row, x, n);
            for (int i = 0; i < n; i++) {
                real residual = -b[i], size = eom_fabs(b[i]);

                for (int j = 0; j < n; j++) {
                    residual += copy[n*i + j]*x[j];
                    size += eom_fabs(copy[n*i + j]*x[j]);
                }
                CHECK(eom_fabs(residual) <= 64*EOM_EPS*size, residual/size);
            }
        }
}

/* Factors of a triangular matrix without exchanges are the matrix itself, with reciprocals on its diagonal. */
static void test_factors(void)
{
    const real U[9] = { 4, 1, 2, 0, 3, 1, 0, 0, 2 };
    real M[9], x[3] = { 9, 5, 2 };
    int row[3];

    memcpy(M, U, sizeof M);
    eom_factor(M, row, 3);
    for (int i = 0; i < 9; i++)
        CHECK(M[i] == (i % 4 == 0 ? 1/U[i] : U[i]), M[i]);
    for (int k = 0; k < 3; k++)
        CHECK(row[k] == k, row[k]);
    eom_substitute(M, row, x, 3);
    CHECK(x[2] == 1, x[2]);
    CHECK(eom_fabs(x[1] - (real)4/3) <= 2*EOM_EPS, x[1]);
}

static void test_singular_matrix_gives_no_finite_solution(void)
{
    real M[4] = { 1, 2, 2, 4 }, x[2] = { 1, 1 };
    int row[2];

    eom_factor(M, row, 2);
    eom_substitute(M, row, x, 2);
    CHECK(!eom_finite(x, 2), x[0]);
}

static void test_derivatives(void)
{
    const eom_model m = { .kind = OSCILLATOR, .k = 9, .c = 4 };
    const real q[2] = { 2, -3 }, qd[2] = { 1, 5 }, exact[8] = { -9, 0, -4, 0, 0, -9, 0, -4 };
    real derivatives[8];

    CHECK(eom_differentiate(derivatives, q, qd, 0, &m) == EOM_OK, 0);
    for (int i = 0; i < 8; i++)
        CHECK(eom_fabs(derivatives[i] - exact[i]) <= 100*EOM_SQRT_EPS, derivatives[i]);
}

static void test_derivatives_need_accelerations(void)
{
    const eom_model m = { .kind = PENDULUM, .reach = EOM_EPS };
    const real q[2] = { 1, 0 }, qd[2] = { 0, 1 };
    real derivatives[8];

    CHECK(eom_differentiate(derivatives, q, qd, 0, &m) == EOM_SINGULAR, 0);
}

static void test_only_finite_states_are_stored(void)
{
    const real r[2] = { 1, 2 }, v[2] = { 3, 4 }, bad[2] = { 5, (real)NAN };
    real q[2] = { 0 }, qd[2] = { 0 };

    CHECK(eom_store_state(q, qd, r, bad) == EOM_NOT_FINITE, 0);
    CHECK(eom_store_state(q, qd, bad, v) == EOM_NOT_FINITE, 0);
    CHECK(q[0] == 0 && qd[0] == 0, q[0]);
    CHECK(eom_store_state(q, qd, r, v) == EOM_OK, 0);
    CHECK(q[1] == 2 && qd[1] == 4, q[1]);
}

int main(void)
{
    test_random_systems();
    test_factors();
    test_singular_matrix_gives_no_finite_solution();
    test_derivatives();
    test_derivatives_need_accelerations();
    test_only_finite_states_are_stored();
    return failures;
}
