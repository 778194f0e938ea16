/*
 * Projection of a state onto the constraints: the nearest position in the metric of the mass matrix D, and the
 * nearest velocity there. Coordinates and velocities may be fixed.
 */

/*
 * The constraint equations, linearised at a state: metric D, Jacobian A and residuals; the holonomic equations come
 * first. The changes d of a position with A d = -residual satisfy them to first order.
 */
typedef struct {
    real D[EOM_NQ*EOM_NQ], A[(int)EOM_NC*(int) EOM_NQ], residual[EOM_NC];
} eom_equations;

/* Largest residuals, relative to the terms of an equation: of a state that stays unchanged, and of a projected one. */
static const real eom_unchanged_residual = 4*EOM_EPS, eom_projected_residual = 4096*EOM_EPS;

#if EOM_ROTATIONS
/*
 * Replace the residuals of axis equations, and their gradients if A is not NULL, by the rotation vector a n of the
 * second frame's error: it is zero only where the loop is closed, and its gradients do not vanish there nor at a
 * quarter turn.
 */
static void eom_replace_rotations(real *residual, real *A, const real *q, real t, const eom_model *m)
{
    enum { NQ = EOM_NQ, COUNT = EOM_ROTATION_ROWS };
    static const real HALF_TURN_ERROR = 4; /* residual at half a turn: more than any rotation vector, at most pi */
    real errors[COUNT*(2 + NQ)];
    int first = 0;

    eom_evaluate_rotation_errors(errors, q, t, m);
    for (int k = 0; k < EOM_ROTATIONS; k++) {
        const int end = eom_rotation_ends[k];
        real square = 0, tangent, part;
        int half;

        for (int r = first; r < end; r++)
            square += errors[r]*errors[r];
        tangent = eom_sqrt(square)/2;
        /* at half a turn the direction back is not unique; the square of the cosine of half the angle is rounding */
        half = !(errors[COUNT + first] > EOM_SQRT_EPS);
        part = tangent > 0 ? eom_atan(tangent)/tangent : 1;
        for (int i = 0; A && i < NQ; i++) {
            real along = 0;

            for (int r = first; r < end && tangent > 0; r++)
                along += errors[r]/(2*tangent)*errors[2*COUNT + NQ*r + i];
            for (int r = first; r < end; r++) {
                const real n = tangent > 0 ? errors[r]/(2*tangent) : 0;
                const real across = errors[2*COUNT + NQ*r + i] - along*n;

                A[NQ*eom_rotation_rows[r] + i] = half ? 0 : part*across + along*n/(1 + tangent*tangent);
            }
        }
        for (int r = first; r < end; r++)
            residual[eom_rotation_rows[r]] = half ? HALF_TURN_ERROR : part*errors[r];
        first = end;
    }
}

#endif
/* Evaluate the Jacobian and the residuals at the position q; the velocity qd has no effect on holonomic equations. */
static void eom_evaluate_equations(eom_equations *x, const real *q, const real *qd, real t, const eom_model *m)
{
    eom_evaluate_jacobian(x->A, q, t, m);
    eom_evaluate_residuals(x->residual, q, qd, t, m);
#if EOM_ROTATIONS
    eom_replace_rotations(x->residual, x->A, q, t, m);
#endif
}

/* Whether the residuals of the first rows are at most the given part of the terms of A at, where at is a state. */
static int eom_satisfies(const eom_equations *x, const real *at, int rows, real part)
{
    enum { NQ = EOM_NQ };
    real largest = 0, widest = 0;

    for (int i = 0; i < NQ; i++)
        largest = eom_fabs(at[i]) > largest ? eom_fabs(at[i]) : largest;
    for (int r = 0; r < rows; r++) {
        real size = 0;

        for (int i = 0; i < NQ; i++)
            size += eom_fabs(x->A[NQ*r + i]);
        widest = size > widest ? size : widest;
    }
    for (int r = 0; r < rows; r++) {
        real terms = widest; /* an equation may have constants if its own terms vanish */

        for (int i = 0; i < NQ; i++)
            terms += eom_fabs(x->A[NQ*r + i])*(eom_fabs(at[i]) + largest);
        if (!(eom_fabs(x->residual[r]) <= part*terms))
            return 0;
    }
    return 1;
}

#if EOM_SUMS
/* Replace equations that depend on one another by independent sums of them. */
static void eom_replace_dependent(eom_equations *x, int rows)
{
    enum { NQ = EOM_NQ };
    real sums[EOM_SUMS][NQ] = { { 0 } }, residuals[EOM_SUMS] = { 0 };

    for (int s = 0; s < EOM_SUMS; s++)
        for (int r = 0; r < rows; r++) {
            residuals[s] += eom_row_sums[s][r]*x->residual[r];
            for (int i = 0; i < NQ; i++)
                sums[s][i] += eom_row_sums[s][r]*x->A[NQ*r + i];
        }
    for (int s = 0; s < EOM_SUMS; s++) {
        x->residual[eom_sum_rows[s]] = residuals[s];
        for (int i = 0; i < NQ; i++)
            x->A[NQ*eom_sum_rows[s] + i] = sums[s][i];
    }
}

#endif
/* Prepare the equations for the least change: make D positive definite, replace dependent rows, fix entries. */
static void eom_prepare_equations(eom_equations *x, const int *fixed, int rows)
{
    enum { NQ = EOM_NQ };

#if EOM_WEIGHTS
    /* D alone is singular; since A d is prescribed for these rows, d does not change */
    for (int r = 0; r < rows; r++)
        for (int i = 0; i < NQ; i++)
            for (int j = 0; j < NQ; j++)
                x->D[NQ*i + j] += eom_row_weights[r]*x->A[NQ*r + i]*x->A[NQ*r + j];
#endif
#if EOM_SUMS
    eom_replace_dependent(x, rows);
#endif
    for (int i = 0; fixed && i < NQ; i++)
        if (fixed[i]) {
            for (int j = 0; j < NQ; j++)
                x->D[NQ*i + j] = x->D[NQ*j + i] = i == j;
            for (int r = 0; r < rows; r++)
                x->A[NQ*r + i] = 0;
        }
}

/* D = L L^T in place (Cholesky). Returns 0 if D is not positive definite. */
#if EOM_PINNED
static int eom_factor_metric(real *D, int rows)
#else
static int eom_factor_metric(real *D)
#endif
{
    enum { NQ = EOM_NQ };

    for (int i = 0; i < NQ; i++) {
#if EOM_PINNED
        static const real ROUNDING = 64*EOM_EPS; /* of a pivot, relative to its diagonal entry */
        const real diagonal = D[NQ*i + i];

#endif
        for (int j = 0; j <= i; j++) {
            for (int k = 0; k < j; k++)
                D[NQ*i + j] -= D[NQ*i + k]*D[NQ*j + k];
            if (j < i)
                D[NQ*i + j] /= D[NQ*j + j];
        }
#if EOM_PINNED
        /* a coordinate without inertia that is in none of these rows does not change */
        if (rows < EOM_NC && eom_fabs(D[NQ*i + i]) <= ROUNDING*diagonal)
            D[NQ*i + i] = 1/EOM_TINY;
#endif
        if (!(D[NQ*i + i] > 0))
            return 0;
        D[NQ*i + i] = eom_sqrt(D[NQ*i + i]);
    }
    return 1;
}

/*
 * Return the row of A, of those that are not used, of which the largest part is left; -1 if they depend on those that
 * are. whole: squares of the original rows. *size = the norm of what is left.
 */
static int eom_choose_row(const real *A, const real *whole, const int *used, int rows, real *size)
{
    enum { NQ = EOM_NQ };
    static const real DEPENDENT = 64*EOM_EPS; /* part of a squared gradient that is rounding */
    real best = DEPENDENT;
    int chosen = -1;

    for (int r = 0; r < rows; r++) {
        real square = 0;

        for (int i = 0; i < NQ; i++)
            square += A[NQ*r + i]*A[NQ*r + i];
        if (!used[r] && square > best*whole[r]) {
            best = square/whole[r];
            *size = eom_sqrt(square);
            chosen = r;
        }
    }
    return chosen;
}

/* Make a row of A, and its residual, orthogonal to a row of length 1. */
static void eom_remove_part(real *row, real *residual, const real *unit_row, real unit_residual)
{
    real part = 0;

    for (int i = 0; i < EOM_NQ; i++)
        part += row[i]*unit_row[i];
    for (int i = 0; i < EOM_NQ; i++)
        row[i] -= part*unit_row[i];
    *residual -= part*unit_residual;
}

/*
 * d = the least change in the metric of D with A d = -residual, for the first rows of the equations: Gram-Schmidt
 * orthogonalisation of the rows with pivoting (Golub & Van Loan, Matrix Computations, sec. 5.2 and 5.4); dependent
 * rows are dropped. fixed: flags of entries that do not change; NULL: none. Overwrites the equations. Returns 0 if D
 * is not positive definite.
 */
static int eom_least_change(real *d, eom_equations *x, const int *fixed, int rows)
{
    enum { NQ = EOM_NQ };
    real *const D = x->D, *const A = x->A, *const residual = x->residual;
    real whole[EOM_NC] = { 0 }, size = 0;
    int used[EOM_NC] = { 0 }, chosen;

#if EOM_REDUNDANT
    for (int r = 0; r < EOM_NC; r++)
        used[r] = eom_redundant_rows[r]; /* other rows imply them */
#endif
    eom_prepare_equations(x, fixed, rows);
#if EOM_PINNED
    if (!eom_factor_metric(D, rows))
#else
    if (!eom_factor_metric(D))
#endif
        return 0;
    for (int r = 0; r < rows; r++) { /* A L^-T */
        whole[r] = 0;
        for (int i = 0; i < NQ; i++) {
            for (int j = 0; j < i; j++)
                A[NQ*r + i] -= D[NQ*i + j]*A[NQ*r + j];
            A[NQ*r + i] /= D[NQ*i + i];
            whole[r] += A[NQ*r + i]*A[NQ*r + i];
        }
    }
    for (int i = 0; i < NQ; i++)
        d[i] = 0;
    while ((chosen = eom_choose_row(A, whole, used, rows, &size)) >= 0) {
        used[chosen] = 1;
        residual[chosen] /= size;
        for (int i = 0; i < NQ; i++) {
            A[NQ*chosen + i] /= size;
            d[i] -= residual[chosen]*A[NQ*chosen + i];
        }
#if EOM_MULTIPLE
        for (int r = 0; r < rows; r++)
            if (!used[r])
                eom_remove_part(A + NQ*r, residual + r, A + NQ*chosen, residual[chosen]);
#endif
    }
    for (int i = NQ - 1; i >= 0; i--) { /* L^-T d */
        for (int j = i + 1; j < NQ; j++)
            d[i] -= D[NQ*j + i]*d[j];
        d[i] /= D[NQ*i + i];
    }
    return 1;
}

#if EOM_HOLONOMIC
/*
 * Add d to the position at, or that part of it with which the residuals decrease. misfit: their squares, divided by
 * those of the gradients. Returns the new misfit. scale: largest coordinate.
 */
static real eom_add_change(real *at, const real *d, const real *squares, real misfit, real scale, const real *qd, real t, const eom_model *m)
{
    enum { NQ = EOM_NQ, MAX_HALVINGS = 30 }; /* the change is then less than 1e-9 of d */
    static const real ROUNDING_SQUARE = 4096*EOM_EPS*EOM_EPS; /* of the misfit: 64 rounding errors */
    real residual[EOM_NC], part = 1, longest = 0;

    for (int i = 0; i < NQ; i++)
        longest = eom_fabs(d[i]) > longest ? eom_fabs(d[i]) : longest;
    /* limit the step, since one across turns may lead anywhere */
    if (2*longest > 1 + scale)
        part = (1 + scale)/(2*longest);
    for (int n = 0; n < MAX_HALVINGS; n++) {
        real now = 0;

        for (int i = 0; i < NQ; i++)
            at[i] += part*d[i];
        eom_evaluate_residuals(residual, at, qd, t, m);
#if EOM_ROTATIONS
        eom_replace_rotations(residual, 0, at, t, m);
#endif
        for (int r = 0; r < EOM_HOLONOMIC_ROWS; r++)
            now += residual[r]*residual[r]/squares[r];
        if (now <= misfit || !(misfit > ROUNDING_SQUARE)) {
            misfit = now;
            break;
        }
        for (int i = 0; i < NQ; i++)
            at[i] -= part*d[i];
        part /= 2;
    }
    return misfit;
}

/* The sum of the squares of NQ numbers. */
static real eom_squared_norm(const real *x)
{
    real sum = 0;

    for (int i = 0; i < EOM_NQ; i++)
        sum += x[i]*x[i];
    return sum;
}

/*
 * Move the position at onto the holonomic constraints: Newton's method by least changes, damped so that the residuals
 * decrease (Deuflhard, Newton Methods for Nonlinear Problems, sec. 3.2 and 4.4).
 */
static eom_status eom_find_position(real *at, const real *qd, real t, const int *fixed, const eom_model *m)
{
    enum { NQ = EOM_NQ, ROWS = EOM_HOLONOMIC_ROWS, MAX_PASSES = 200 }; /* quadratic convergence needs few; damping many */
    /* squares of relative changes of q: rounding errors; misfit whose residuals need no further check */
    static const real ROUNDING_SQUARE = 4096*EOM_EPS*EOM_EPS, ENOUGH_SQUARE = 4096*4096*EOM_EPS*EOM_EPS;
    eom_equations x;
    real d[NQ], squares[EOM_NC], misfit = 0, scale = 0, size = 0, last_change = 0;

    for (int i = 0; i < NQ; i++)
        scale = eom_fabs(at[i]) > scale ? eom_fabs(at[i]) : scale;
    for (int pass = 0; pass < MAX_PASSES; pass++) {
        real change;

        eom_evaluate_metric(x.D, at, t, m);
        eom_evaluate_equations(&x, at, qd, t, m);
#if EOM_SEARCH
        misfit = 0;
#endif
        for (int r = 0; r < ROWS; r++) {
            squares[r] = EOM_TINY;
            for (int i = 0; i < NQ; i++)
                squares[r] += x.A[NQ*r + i]*x.A[NQ*r + i];
#if EOM_SEARCH
            misfit += x.residual[r]*x.residual[r]/squares[r];
#else
            misfit += pass == 0 ? x.residual[r]*x.residual[r]/squares[r] : 0;
#endif
        }
        if (!eom_least_change(d, &x, fixed, ROWS))
            return EOM_SINGULAR;
        misfit = eom_add_change(at, d, squares, misfit, scale, qd, t, m);
        change = eom_squared_norm(d);
        size = eom_squared_norm(at);
        if (!(change > ROUNDING_SQUARE*size))
            break;
        if (pass && 2*change > last_change) { /* near zero, rounding errors of the residuals exceed that */
            eom_evaluate_equations(&x, at, qd, t, m);
            if (eom_satisfies(&x, at, ROWS, eom_unchanged_residual))
                break;
        }
        last_change = change;
    }
    if (misfit <= ENOUGH_SQUARE*size)
        return EOM_OK;
    eom_evaluate_equations(&x, at, qd, t, m);
    return eom_satisfies(&x, at, ROWS, eom_projected_residual) ? EOM_OK : EOM_LOCKED;
}

/*
 * Move the position at, which satisfies the constraints, to the nearest one from q: iterate the least change from q
 * that satisfies the equations linearised at the last position; by a part of it if the iteration does not converge.
 * If the result is not on the constraints, at does not change.
 */
static void eom_find_nearest(real *at, const real *q, const real *qd, real t, const int *fixed, const eom_model *m)
{
    enum { NQ = EOM_NQ, ROWS = EOM_HOLONOMIC_ROWS, MAX_PASSES = 200 };
    static const real ROUNDING_SQUARE = 4096*EOM_EPS*EOM_EPS; /* of a relative change: 64 rounding errors */
    static const real MIN_PART = (real)0.015625; /* of a change, 1/64: less of it takes too many iterations */
    static const real CONVERGED = (real)1e-14; /* squared last change, relative to the distance */
    eom_equations x;
    real d[NQ], start[NQ], part = 1, distance = 0, size = eom_squared_norm(at), before = 1, last = 1;
    int converged;

    for (int i = 0; i < NQ; i++)
        start[i] = at[i];
    for (int pass = 0; pass < MAX_PASSES && last > ROUNDING_SQUARE*size; pass++) {
        eom_evaluate_metric(x.D, at, t, m);
        eom_evaluate_equations(&x, at, qd, t, m);
        for (int r = 0; r < ROWS; r++)
            for (int i = 0; i < NQ; i++)
                x.residual[r] += x.A[NQ*r + i]*(q[i] - at[i]);
        if (!eom_least_change(d, &x, fixed, ROWS))
            break;
        last = 0;
        for (int i = 0; i < NQ; i++) {
            const real change = q[i] + d[i] - at[i];

            last += change*change;
            at[i] += part*change;
        }
        distance = eom_squared_norm(d);
        size = eom_squared_norm(at);
        if (pass && 2*last > before)
            part /= 2;
        if (part < MIN_PART)
            break;
        before = last;
    }
    if (part < 1 && last <= CONVERGED*distance) { /* remove the residuals that partial changes leave */
        eom_evaluate_metric(x.D, at, t, m);
        eom_evaluate_equations(&x, at, qd, t, m);
        if (eom_least_change(d, &x, fixed, ROWS))
            for (int i = 0; i < NQ; i++)
                at[i] += d[i];
    }
    eom_evaluate_equations(&x, at, qd, t, m);
    converged = last <= ROUNDING_SQUARE*size || last <= CONVERGED*distance;
    if (!converged || !eom_satisfies(&x, at, ROWS, eom_projected_residual))
        for (int i = 0; i < NQ; i++)
            at[i] = start[i];
}

#endif
#if EOM_SEARCH
/*
 * Find a position on the constraints from q, then from random positions around it at increasing distances: at q
 * itself the gradient of an equation may vanish, or a rotation be half a turn off.
 */
static eom_status eom_search_position(real *at, const real *q, const real *qd, real t, const int *fixed, const eom_model *m)
{
    enum { NQ = EOM_NQ, STARTS = 16 };
    static const real DISTANCE = 5; /* reciprocal of how much farther each start is */
    eom_status status = EOM_OK;
    unsigned int seed = 1;

    for (int start = 0; start <= STARTS; start++) {
        for (int i = 0; i < NQ; i++) {
            real random;

            seed = 1664525U*seed + 1013904223U; /* Press et al., Numerical Recipes, sec. 7.1 */
            random = (real)(seed >> 16 & 32767U)/16384 - 1; /* within -1 and 1 */
            at[i] = q[i];
            if (start && !(fixed && fixed[i]))
                at[i] += (real)start*random/DISTANCE;
        }
        status = eom_find_position(at, qd, t, fixed, m);
        if (status == EOM_OK)
            break;
    }
    return status;
}

#endif
/* Move the velocity qd at the position q onto the constraints by its least change, twice because of rounding. */
static eom_status eom_project_velocity(real *qd, const real *q, real t, const int *fixed, const eom_model *m)
{
    enum { NQ = EOM_NQ, NC = EOM_NC };
    eom_equations x;
    real d[NQ] = { 0 };
    int singular = 0;

    for (int pass = 0; pass < 2; pass++) {
        eom_evaluate_metric(x.D, q, t, m);
        eom_evaluate_jacobian(x.A, q, t, m);
        eom_evaluate_rates(x.residual, q, qd, t, m);
        singular |= !eom_least_change(d, &x, fixed, NC);
        for (int i = 0; i < NQ; i++)
            qd[i] += d[i];
    }
    eom_evaluate_jacobian(x.A, q, t, m);
    eom_evaluate_rates(x.residual, q, qd, t, m);
    if (singular || !eom_satisfies(&x, qd, NC, eom_projected_residual))
        return singular ? EOM_SINGULAR : EOM_LOCKED;
    return EOM_OK;
}

/* Whether the state q, qd satisfies all constraints to rounding. */
static int eom_is_consistent(const real *q, const real *qd, real t, const eom_model *m)
{
    eom_equations x;

#if EOM_HOLONOMIC
    eom_evaluate_equations(&x, q, qd, t, m);
    if (!eom_satisfies(&x, q, EOM_HOLONOMIC_ROWS, eom_unchanged_residual))
        return 0;
#if EOM_ROTATIONS
    eom_evaluate_jacobian(x.A, q, t, m);
#endif
#else
    eom_evaluate_jacobian(x.A, q, t, m);
#endif
    eom_evaluate_rates(x.residual, q, qd, t, m);
    return eom_satisfies(&x, qd, EOM_NC, eom_unchanged_residual);
}

/*
 * Project the state q, qd onto the constraints. fixed: 2 NQ flags of coordinates and velocities that do not change;
 * NULL: none. If the status is not OK, the state is unchanged.
 */
static eom_status eom_project_state(real *q, real *qd, real t, const int *fixed, const eom_model *m)
{
    enum { NQ = EOM_NQ };
    real at[NQ], moving[NQ];
    eom_status status;

    for (int i = 0; i < NQ; i++) {
        at[i] = q[i];
        moving[i] = qd[i];
    }
    if (!eom_finite(q, NQ) || !eom_finite(qd, NQ))
        return EOM_NOT_FINITE;
    if (eom_is_consistent(q, qd, t, m))
        return EOM_OK;
#if EOM_HOLONOMIC
#if EOM_SEARCH
    status = eom_search_position(at, q, qd, t, fixed, m);
#else
    status = eom_find_position(at, qd, t, fixed, m);
#endif
    if (status)
        return status;
    eom_find_nearest(at, q, qd, t, fixed, m);
#endif
    status = eom_project_velocity(moving, at, t, fixed ? fixed + NQ : 0, m);
    if (status)
        return status;
    for (int i = 0; i < NQ; i++) {
        q[i] = at[i];
        qd[i] = moving[i];
    }
    return EOM_OK;
}
