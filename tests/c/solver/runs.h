/* Runs in tests of adaptive steps and of events. Included after the library. */

enum { NQ = EOM_NQ, ROOM = 300 };

static const real PI = (real)3.14159265358979323846;

typedef struct {
    real q[NQ], qd[NQ];
    eom_options options;
    eom_output output;
    eom_workspace workspace;
#if EOM_EVENTS
    int which[ROOM];
    real event_rows[ROOM*(1 + 2*NQ)];
#endif
} run;

static void start(run *r, real q0, real q1, real qd0, real qd1)
{
    memset(r, 0, sizeof *r);
    r->q[0] = q0;
    r->q[1] = q1;
    r->qd[0] = qd0;
    r->qd[1] = qd1;
    r->options.steps = 100000;
}

/* Continue a run to t_end; returns its status. */
static eom_status integrate(run *r, real t_end, real tol, const eom_model *m)
{
#if EOM_EVENTS
    r->output.room = ROOM;
    r->output.which = r->which;
    r->output.event_rows = r->event_rows;
#endif
    r->output.memory = &r->workspace;
    r->options.t_end = t_end;
    r->options.tol = tol;
    return eom_run(r->q, r->qd, &r->options, m, &r->output);
}
