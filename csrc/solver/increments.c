/* Projection of the increments of a step onto the constraints. */

/* Change the increments r and v of a step from q, qd such that its end satisfies the constraints at time t. */
static eom_status eom_project_increments(real *r, real *v, const real *q, const real *qd, real t, const eom_model *m, int *singular)
{
    real end_q[EOM_NQ], end_qd[EOM_NQ];
    eom_status status;

    for (int k = 0; k < EOM_NQ; k++) {
        end_q[k] = q[k] + r[k];
        end_qd[k] = qd[k] + v[k];
    }
    status = eom_project_end(end_q, end_qd, q, t, m, singular);
    if (status)
        return status;
    for (int k = 0; k < EOM_NQ; k++) {
        r[k] = end_q[k] - q[k];
        v[k] = end_qd[k] - qd[k];
    }
    return EOM_OK;
}
