/* Polynomials of the stage accelerations: prediction, increments of a step, interpolant. */

/* The sum of x over the stages. */
static real eom_sum(const real *x)
{
    enum { S = EOM_GAUSS_STAGES };
    real half[S/2], quarter[S/4];

    EOM_LANES for (int i = 0; i < S/2; i++)
        half[i] = x[i] + x[S/2 + i];
    EOM_LANES for (int i = 0; i < S/4; i++)
        quarter[i] = half[i] + half[S/4 + i];
    return quarter[0] + quarter[1];
}

/* The sum of w x over the stages. */
static real eom_weighted_sum(const real *w, const real *x)
{
    enum { S = EOM_GAUSS_STAGES };
    real product[S];

    EOM_LANES for (int i = 0; i < S; i++)
        product[i] = w[i]*x[i];
    return eom_sum(product);
}

/*
 * a = the accelerations that the interpolant of the last step predicts at the stages of a step that starts at
 * `from` and has the size `part`, both in units of the last step's size.
 */
static void eom_predict_stages(eom_gauss_stages *a, const eom_run_state *s, real from, real part)
{
    enum { S = EOM_GAUSS_STAGES };
    real at[S];

    EOM_LANES for (int i = 0; i < S; i++)
        at[i] = 2*(from + part*eom_gauss_c[i]) - 1;
    for (int k = 0; k < EOM_NQ; k++) {
        const real *const p = s->powers[k];
        const real p0 = p[0], p1 = p[1], p2 = p[2], p3 = p[3], p4 = p[4], p5 = p[5], p6 = p[6], p7 = p[7];

        EOM_LANES for (int i = 0; i < S; i++) { /* Estrin's scheme */
            const real z = at[i], zz = z*z;

            a->x[k][i] = p0 + (p1*z + ((p2 + p3*z)*zz + ((p4 + p5*z) + (p6 + p7*z)*zz)*(zz*zz)));
        }
    }
}

/* Store the polynomial through the accelerations at the stages of the last step. */
static void eom_store_interpolant(eom_run_state *s, const eom_gauss_stages *a)
{
    enum { S = EOM_GAUSS_STAGES, NQ = EOM_NQ };

    for (int k = 0; k < NQ; k++) {
        real even[S] = { 0 }, odd[S] = { 0 };

        for (int i = 0; i < S; i += 2)
            EOM_LANES for (int j = 0; j < S; j++) {
                even[j] += eom_gauss_to_powers[i][j]*a->x[k][i];
                odd[j] += eom_gauss_to_powers[i + 1][j]*a->x[k][i + 1];
            }
        EOM_LANES for (int j = 0; j < S; j++)
            s->powers[k][j] = even[j] + odd[j];
    }
}

/* r, v = the increments of q and qd in a step of size h with the accelerations a at its stages. */
static void eom_step_increments(real *r, real *v, const eom_gauss_stages *a, const real *qd, real h)
{
    enum { S = EOM_GAUSS_STAGES };

    for (int k = 0; k < EOM_NQ; k++) {
        real even[2] = { 0 }, odd[2] = { 0 };

        for (int i = 0; i < S; i += 2)
            EOM_LANES for (int j = 0; j < 2; j++) {
                even[j] += eom_gauss_weights[i][j]*a->x[k][i];
                odd[j] += eom_gauss_weights[i + 1][j]*a->x[k][i + 1];
            }
        r[k] = h*qd[k] + h*h*(even[0] + odd[0]);
        v[k] = h*(even[1] + odd[1]);
    }
}

/* q1, qd1 = the state at the end of that step from q, qd. */
static void eom_step_end(real *q1, real *qd1, const eom_gauss_stages *a, const real *q, const real *qd, real h)
{
    eom_step_increments(q1, qd1, a, qd, h);
    for (int k = 0; k < EOM_NQ; k++) {
        q1[k] += q[k];
        qd1[k] += qd[k];
    }
}

#if EOM_EVENTS
/*
 * q, qd = the state at the fraction z of the last step, from the interpolant: the integral from 0 to z of (2 z - 1)^n is
 * power/(2 (n + 1)) with power = (2 z - 1)^(n + 1) - (-1)^(n + 1), which is computed without cancellation; so is its integral.
 */
static void eom_interpolate(real *q, real *qd, const eom_run_state *s, real z)
{
    enum { N = EOM_GAUSS_STAGES };
    static const real half[9] = { (real)0.5, (real)0.5/2, (real)0.5/3, (real)0.5/4, (real)0.5/5, (real)0.5/6, (real)0.5/7, (real)0.5/8, (real)0.5/9 };
    const real h = s->size;
    real once[N + 1], twice[N], power = 0;

    for (int n = 0; n <= N; n++) {
        power = (2*z - 1)*power + (n % 2 ? -2*z : 2*z);
        once[n] = half[n]*power;
    }
    for (int n = 0; n < N; n++)
        twice[n] = half[n]*(once[n + 1] + (n % 2 ? -z : z));
    for (int i = 0; i < EOM_NQ; i++) {
        real position = 0, velocity = 0;

        for (int n = 0; n < N; n++) {
            position += twice[n]*s->powers[i][n];
            velocity += once[n]*s->powers[i][n];
        }
        q[i] = s->q0[i] + h*(z*s->qd0[i] + h*position);
        qd[i] = s->qd0[i] + h*velocity;
    }
}

/* q, qd = the state at node j of the last step, from the interpolant. */
static void eom_interpolate_node(real *q, real *qd, const eom_run_state *s, int j)
{
    const real z = eom_nodes[j], h = s->size;

    for (int i = 0; i < EOM_NQ; i++) {
        real position = 0, velocity = 0;

        for (int n = 0; n < EOM_GAUSS_STAGES; n++) {
            position += eom_twice_integrated[j][n]*s->powers[i][n];
            velocity += eom_once_integrated[j][n]*s->powers[i][n];
        }
        q[i] = s->q0[i] + h*(z*s->qd0[i] + h*position);
        qd[i] = s->qd0[i] + h*velocity;
    }
}

#endif
