/* States: copies. */

/* q1, qd1 = q, qd. */
static void eom_copy_state(real *q1, real *qd1, const real *q, const real *qd)
{
    for (int i = 0; i < EOM_NQ; i++) {
        q1[i] = q[i];
        qd1[i] = qd[i];
    }
}

/* Copy the state r, v to q, qd if it is finite. */
static eom_status eom_store_state(real *q, real *qd, const real *r, const real *v)
{
    if (!eom_finite(r, EOM_NQ) || !eom_finite(v, EOM_NQ))
        return EOM_NOT_FINITE;
    eom_copy_state(q, qd, r, v);
    return EOM_OK;
}
