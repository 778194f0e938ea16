/*
 * Derivatives of a step of a Runge-Kutta method by the chain rule over its stages (Hairer, Norsett & Wanner, Solving
 * ODEs I, sec. I.14), with respect to W = EOM_VARIABLES variables: q and qd at its start, the inputs u, and the parameters p
 * of scenes that request them. Matrices of derivatives have W columns. Those of the accelerations at the stages, X, have
 * NQ rows for each stage.
 */

/* J = the derivatives of the accelerations with respect to the variables. */
#if EOM_FEEDBACK
/* If u is NULL, feedback by the scene's signals is included. */
#endif
#if EOM_SIGNAL_PARAMETERS
/* If u is NULL, the parameters of the scene's signals are included. */
#endif
static eom_status eom_differentiate_accelerations(real *J, const real *q, const real *qd, real t, const eom_model *m)
{
    enum { NQ = EOM_NQ, W = EOM_VARIABLES };
    real A_q[NQ*NQ], A_qd[NQ*NQ];
#if EOM_INPUTS
    enum { NU = EOM_NU };
    real B[(int)NQ*NU];
    const eom_status status = eom_evaluate_linearization(A_q, A_qd, B, q, qd, t, m);
#else
    const eom_status status = eom_evaluate_linearization(A_q, A_qd, q, qd, t, m);
#endif
#if EOM_FEEDBACK
    real K[NU*2*NQ];
#endif
#if EOM_PARAMETERS
    enum { NP = EOM_NP };
    real E[(int)NQ*NP];
#endif
#if EOM_SIGNAL_PARAMETERS
    real u_p[(int)NU*NP];
#endif

    if (status)
        return status;
    for (int i = 0; i < NQ; i++) {
        for (int j = 0; j < NQ; j++) {
            J[W*i + j] = A_q[NQ*i + j];
            J[W*i + NQ + j] = A_qd[NQ*i + j];
        }
#if EOM_INPUTS
        for (int j = 0; j < NU; j++)
            J[W*i + 2*NQ + j] = B[NU*i + j];
#endif
    }
#if EOM_PARAMETERS
    eom_evaluate_parameter_derivatives(E, q, qd, t, m);
    for (int i = 0; i < NQ; i++)
        for (int j = 0; j < NP; j++)
            J[W*i + W - NP + j] = E[NP*i + j];
#endif
#if EOM_FEEDBACK
    if (!m->u) {
        eom_evaluate_signal_derivatives(K, q, qd, t, m);
        for (int i = 0; i < NQ; i++)
            for (int j = 0; j < 2*NQ; j++)
                for (int k = 0; k < NU; k++)
                    J[W*i + j] += B[NU*i + k]*K[2*NQ*k + j];
    }
#endif
#if EOM_SIGNAL_PARAMETERS
    if (!m->u) {
        eom_evaluate_signal_sensitivity(u_p, q, qd, t, m);
        for (int i = 0; i < NQ; i++)
            for (int j = 0; j < NP; j++)
                for (int k = 0; k < NU; k++)
                    J[W*i + W - NP + j] += B[NU*i + k]*u_p[NP*k + j];
    }
#endif
    return EOM_OK;
}

/*
 * X = the derivatives of the accelerations at stage i of an explicit method, from those at the stages before it,
 * stage by stage, and the derivatives J by the state of stage i. With sums S = sum_j A_ij X_j and SS = sum_j AA_ij X_j,
 * the derivatives of that state are [1, h c, 0] + h^2 SS and [0, 1, 0] + h S, whose constant parts need no product.
 */
static void eom_method_stage_derivatives(real *X, const real *J, int i, real h)
{
    enum { NQ = EOM_NQ, W = EOM_VARIABLES };
    const real *const A = eom_method_A[i], *const AA = eom_method_AA[i], c = eom_method_c[i];
    real *const own = X + W*NQ*i;
    real S[NQ*W], SS[NQ*W];

    for (int k = 0; k < NQ; k++) {
        for (int w = 0; w < W; w++)
            own[W*k + w] = J[W*k + w];
        for (int l = 0; l < NQ; l++)
            own[W*k + NQ + l] += h*c*J[W*k + l];
    }
    if (i == 0)
        return;
    for (int k = 0; k < NQ*W; k++) {
        real of_q = 0, of_qd = 0;

        for (int j = 0; j < i; j++) {
            of_q += AA[j]*X[W*NQ*j + k];
            of_qd += A[j]*X[W*NQ*j + k];
        }
        SS[k] = h*h*of_q;
        S[k] = h*of_qd;
    }
    for (int k = 0; k < NQ; k++)
        for (int l = 0; l < NQ; l++) {
            const real by_q = J[W*k + l], by_qd = J[W*k + NQ + l];

            for (int w = 0; w < W; w++)
                own[W*k + w] = own[W*k + w] + by_q*SS[W*l + w] + by_qd*S[W*l + w];
        }
}

/* a = the accelerations at the stages of an explicit method, X = their derivatives, stage by stage. */
static eom_status eom_method_differentiate_explicit_stages(real *X, real *a, const real *q, const real *qd, real t, real h, const eom_model *m)
{
    enum { NQ = EOM_NQ, W = EOM_VARIABLES };
    real J[NQ*W], r[NQ], v[NQ];

    for (int i = 0; i < EOM_METHOD_STAGES; i++) {
        eom_status status;

        eom_method_stage_state(r, v, a, i, i, q, qd, h);
        status = eom_accelerate(a + NQ*i, r, v, t + eom_method_c[i]*h, m);
        if (status == EOM_OK)
            status = eom_differentiate_accelerations(J, r, v, t + eom_method_c[i]*h, m);
        if (status)
            return status;
        eom_method_stage_derivatives(X, J, i, h);
    }
    return EOM_OK;
}

/* X = M^-1 X by elimination with pivoting, M (n, n), X (n, width). Overwrites M. */
static void eom_eliminate(real *M, real *X, int n, int width)
{
    for (int k = 0; k < n; k++) {
        int row = k;

        for (int i = k + 1; i < n; i++)
            if (eom_fabs(M[n*i + k]) > eom_fabs(M[n*row + k]))
                row = i;
        for (int j = k; j < n && row != k; j++) {
            const real upper = M[n*k + j];

            M[n*k + j] = M[n*row + j];
            M[n*row + j] = upper;
        }
        for (int j = 0; j < width && row != k; j++) {
            const real upper = X[width*k + j];

            X[width*k + j] = X[width*row + j];
            X[width*row + j] = upper;
        }
        for (int i = k + 1; i < n; i++) {
            const real factor = M[n*i + k]/M[n*k + k];

            for (int j = k + 1; j < n; j++)
                M[n*i + j] -= factor*M[n*k + j];
            for (int j = 0; j < width; j++)
                X[width*i + j] -= factor*X[width*k + j];
        }
    }
    for (int k = n - 1; k >= 0; k--)
        for (int j = 0; j < width; j++) {
            for (int i = k + 1; i < n; i++)
                X[width*k + j] -= M[n*k + i]*X[width*i + j];
            X[width*k + j] /= M[n*k + k];
        }
}

/*
 * The linear equations M X = right-hand side (in X) at the stages of an implicit method to which the accelerations a
 * lead: W columns of X for the derivatives of a, and the last one for the Newton correction of a.
 */
static eom_status eom_method_stage_equations(real *M, real *X, const real *a, const real *q, const real *qd, real t, real h, const eom_model *m)
{
    enum { NQ = EOM_NQ, W = EOM_VARIABLES, ROW = W + 1 };
    const int S = EOM_METHOD_STAGES, N = S*NQ;
    real J[NQ*W], f[NQ], r[NQ], v[NQ];

    for (int i = 0; i < S; i++) {
        const real c = eom_method_c[i], *const A = eom_method_A[i], *const AA = eom_method_AA[i];
        eom_status status;

        eom_method_stage_state(r, v, a, i, S, q, qd, h);
        status = eom_accelerate(f, r, v, t + c*h, m);
        if (status == EOM_OK)
            status = eom_differentiate_accelerations(J, r, v, t + c*h, m);
        if (status)
            return status;
        for (int k = 0; k < NQ; k++) {
            const int row = NQ*i + k;

            for (int j = 0; j < S; j++)
                for (int l = 0; l < NQ; l++) {
                    const real of_qd = A[j]*J[W*k + NQ + l];

                    M[N*row + NQ*j + l] = (real)(row == NQ*j + l) - h*(of_qd + h*AA[j]*J[W*k + l]);
                }
            for (int w = 0; w < W; w++)
                X[ROW*row + w] = J[W*k + w];
            for (int l = 0; l < NQ; l++)
                X[ROW*row + NQ + l] += h*c*J[W*k + l];
            X[ROW*row + W] = f[k] - a[row];
        }
    }
    return EOM_OK;
}

/*
 * a = the accelerations at the stages of an implicit method by Newton's method with the matrix M, and X = their
 * derivatives by one solution with the same M. scale: at least the largest velocity.
 */
static eom_status eom_method_differentiate_implicit_stages(real *X, real *a, real *scale, const real *q, const real *qd, real t, real h, const eom_model *m)
{
    enum { NQ = EOM_NQ, W = EOM_VARIABLES, ROW = W + 1, MAX_ITERATIONS = 50 };
    /* Newton correction of velocities, relative to them, with which the iteration ends: in general, and if the
     * corrections no longer decrease by half and the rest is rounding */
    static const real CONVERGED = 16*EOM_EPS, ROUNDING = EOM_SQRT_EPS;
    const int N = EOM_METHOD_STAGES*NQ;
    real M[EOM_METHOD_STAGES*NQ*EOM_METHOD_STAGES*NQ], last = 0;
    eom_status status = eom_accelerate(a, q, qd, t, m);

    if (status)
        return status;
    for (int i = NQ; i < N; i++)
        a[i] = a[i - NQ];
    for (int n = 0; n <= MAX_ITERATIONS; n++) {
        real change = 0;

        status = eom_method_stage_equations(M, X, a, q, qd, t, h, m);
        if (status)
            return status;
        eom_eliminate(M, X, N, ROW);
        for (int i = 0; i < N; i++) {
            const real d = X[ROW*i + W];

            if (!eom_finite(&d, 1))
                return EOM_NO_CONVERGENCE;
            a[i] += d;
            change = eom_fmax(change, eom_fabs(h*d));
            *scale = eom_fmax(*scale, eom_fabs(qd[i % NQ]) + eom_fabs(h*a[i]));
        }
        if (change <= CONVERGED*(*scale) || (n > 0 && change >= last/2 && change <= ROUNDING*(*scale)))
            return EOM_OK;
        last = change;
    }
    return EOM_NO_CONVERGENCE;
}

/* ends = the derivatives of q and qd at the end of the step, from X, whose rows have the given length. */
static void eom_method_end_derivatives(real *ends, const real *X, int row, real h)
{
    enum { NQ = EOM_NQ, W = EOM_VARIABLES };

    for (int k = 0; k < NQ; k++)
        for (int w = 0; w < W; w++) {
            real of_q = 0, of_qd = 0;

            for (int j = 0; j < EOM_METHOD_STAGES; j++) {
                of_q += eom_method_bA[j]*X[row*(NQ*j + k) + w];
                of_qd += eom_method_b[j]*X[row*(NQ*j + k) + w];
            }
            ends[W*k + w] = (real)(w == k) + h*((real)(w == NQ + k) + h*of_q);
            ends[W*(NQ + k) + w] = (real)(w == NQ + k) + h*of_qd;
        }
}

/*
 * Project the state r, v at the end of a step from q, and its derivatives X, onto the constraints by Newton's method,
 * as the step does. One more correction follows: the error of its derivatives is as large as the correction before.
 */
static eom_status eom_project_derivatives(real *X, real *r, real *v, const real *q, real t, const eom_model *m)
{
    enum { NQ = EOM_NQ, W = EOM_VARIABLES, MAX_PASSES = 12 };
    /* as in eom_apply_correction: bounds of squares, and weight of the increment */
    static const real SMALL = 8*EOM_EPS, ZERO = (real)1e-12, STEP_WEIGHT = 100;
    real along[W], column[4*NQ];

    for (int pass = 0, left = 2; pass < MAX_PASSES && left; pass++) {
        real total = 0;
        int is_large = 0;

        for (int w = 0; w < W; w++) {
            for (int i = 0; i < W; i++)
                along[i] = i < 2*NQ ? X[W*i + w] : (real)(i == w);
            if (eom_evaluate_correction_along(column, along, r, v, t, m))
                return EOM_SINGULAR;
            for (int i = 0; i < 2*NQ; i++)
                X[W*i + w] += column[2*NQ + i];
        }
        for (int i = 0; i < NQ; i++)
            total += r[i]*r[i];
        for (int i = 0; i < NQ; i++) {
            const real step = r[i] - q[i];

            is_large |= column[i]*column[i] > SMALL*(r[i]*r[i] + STEP_WEIGHT*step*step + ZERO*total);
            r[i] += column[i];
            v[i] += column[NQ + i];
        }
        left -= !is_large;
    }
    return EOM_OK;
}

/* Whether r, v differ from the end at, moving of the step by more than rounding. scale: at least the largest velocity. */
static int eom_ends_differ(const real *r, const real *v, const real *at, const real *moving, const real *q, const real *qd, real h, real scale)
{
    static const real ROUNDING = EOM_SQRT_EPS; /* of q/h, relative */
    static const real OTHER_SOLUTION = EOM_FOURTH_ROOT_EPS; /* relative distance of the ends: other stages */
    real distance = 0; /* as a velocity */

    for (int k = 0; k < EOM_NQ; k++) {
        scale = eom_fmax(scale, eom_fabs(qd[k]) + eom_fabs(v[k] - qd[k]) + ROUNDING*eom_fabs(q[k]/h));
        distance = eom_fmax(distance, eom_fabs((at[k] - r[k])/h));
        distance = eom_fmax(distance, eom_fabs(moving[k] - v[k]));
    }
    return distance > OTHER_SOLUTION*scale;
}

/* to = columns of the derivatives of the end of a step, (2 NQ, count). */
static void eom_copy_columns(real *to, const real *ends, int first, int count)
{
    enum { W = EOM_VARIABLES };

    for (int k = 0; k < 2*EOM_NQ; k++)
        for (int w = 0; w < count; w++)
            to[count*k + w] = ends[W*k + first + w];
}

#if EOM_CONSTRAINTS
/* ends = the derivatives of the end of a step of an explicit method; q1, qd1: the end of the step itself. */
static eom_status eom_method_differentiate_explicit_step(real *ends, const real *q1, const real *qd1, const real *q, const real *qd, real t, real h, const eom_model *m)
#else
/* ends = the derivatives of the end of a step of an explicit method. */
static eom_status eom_method_differentiate_explicit_step(real *ends, const real *q, const real *qd, real t, real h, const eom_model *m)
#endif
{
    enum { S = EOM_METHOD_STAGES, NQ = EOM_NQ, W = EOM_VARIABLES };
    real a[S*NQ] = { 0 }, X[S*NQ*W] = { 0 };
    eom_status status;
#if EOM_CONSTRAINTS
    real r[NQ], v[NQ];
#endif

    status = eom_method_differentiate_explicit_stages(X, a, q, qd, t, h, m);
    if (status)
        return status;
    eom_method_end_derivatives(ends, X, W, h);
#if EOM_CONSTRAINTS
    eom_method_end_state(r, v, a, q, qd, h);
    status = eom_project_derivatives(ends, r, v, q, t + h, m);
    if (status)
        return status;
    if (eom_ends_differ(r, v, q1, qd1, q, qd, h, EOM_TINY))
        return EOM_LOCKED; /* the projection of the step ended elsewhere */
#endif
    return EOM_OK;
}

/* ends = the derivatives of the end of a step of an implicit method; q1, qd1: the end of the step itself. */
static eom_status eom_method_differentiate_implicit_step(real *ends, const real *q1, const real *qd1, const real *q, const real *qd, real t, real h, const eom_model *m)
{
    enum { S = EOM_METHOD_STAGES, NQ = EOM_NQ, W = EOM_VARIABLES, ROW = W + 1 };
    real a[S*NQ], X[S*NQ*ROW], r[NQ], v[NQ], scale = EOM_TINY;
    eom_status status;

    status = eom_method_differentiate_implicit_stages(X, a, &scale, q, qd, t, h, m);
    if (status)
        return status;
    eom_method_end_derivatives(ends, X, ROW, h);
    eom_method_end_state(r, v, a, q, qd, h);
#if EOM_CONSTRAINTS
    status = eom_project_derivatives(ends, r, v, q, t + h, m);
    if (status)
        return status;
#endif
    if (eom_ends_differ(r, v, q1, qd1, q, qd, h, scale))
        return EOM_NO_CONVERGENCE; /* the stages of the step are another solution */
    return EOM_OK;
}
