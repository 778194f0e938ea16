/* Events: roots of event functions, and runs with adaptive or fixed steps in which events are detected. */
#include "model.h"

#include "check.h"
#include "adaptive.h"
#include "runs.h"

static real linear(real z)
{
    return z - (real)0.3;
}

static real cubic(real z)
{
    return (z - (real)0.31)*(z - (real)0.34)*(z + 1);
}

static real touching(real z)
{
    return (z - (real)0.4)*(z - (real)0.4) + (real)1e-4;
}

static real steep(real z)
{
    return TANH(20*(z - (real)0.9));
}

/* The first root of an event function is found from its values at the nodes, and refined by shorter steps. */
static void test_roots(void)
{
    static const struct {
        real (*function)(real), from, root; /* 2: none */
    } cases[] = {
        { linear, 0, (real)0.3 },
        { linear, (real)0.31, 2 },
        { cubic, 0, (real)0.31 },
        { cubic, (real)0.32, (real)0.34 },
        { touching, 0, 2 },
        { steep, 0, (real)0.9 },
    };

    for (int n = 0; n < 6; n++) {
        const eom_model m = { .kind = POLYNOMIAL, .mark = cases[n].function };
        eom_event_samples samples[EOM_NE];
        eom_run_state s;
        eom_output output;
        eom_root x;

        memset(&s, 0, sizeof s);
        memset(&output, 0, sizeof output);
#if EOM_ADAPTIVE
        s.fixed = 1;
#endif
        s.qd0[0] = s.size = 1; /* q[0] = z */
#if EOM_ADAPTIVE
        s.part_width = 1;
#endif
        eom_sample_events(samples, &s, &m);
        samples[1].from = cases[n].from;
        s.event[1].sign = cases[n].function(cases[n].from) > 0 ? 1 : -1;
        x.k = 1;
        x.scale = 1;
        x.z = eom_find_root((real)s.event[1].sign, &samples[1]);
        if (x.z <= 1)
            CHECK(eom_refine_root(&x, &samples[1], &s, &m, &output), x.z);
        CHECK(eom_fabs(x.z - cases[n].root) <= EOM_CLOSE, x.z);
    }
}

/* A series has the values at its nodes, and its zeros are those of the function. */
static void test_series(void)
{
    real g[EOM_SAMPLES], c[EOM_SAMPLES];

    for (int j = 0; j < EOM_SAMPLES; j++)
        g[j] = cubic(eom_nodes[j]);
    eom_fit_series(c, g);
    for (int j = 0; j < EOM_SAMPLES; j++)
        CHECK(eom_fabs(eom_evaluate_series(c, eom_nodes[j]) - g[j]) <= 32*EOM_EPS, j);
    CHECK(eom_fabs(eom_find_zero(c, 1, 0, (real)0.32) - (real)0.31) <= EOM_CLOSE, 0);
    CHECK(eom_fabs(eom_find_zero(c, -1, (real)0.32, 1) - (real)0.34) <= EOM_CLOSE, 1);
}

/* Begin a run from rest with fixed or adaptive steps. */
static void start_from_rest(run *r, real height, real q1, int fixed)
{
    start(r, height, q1, 0, 0);
    r->options.h = fixed ? (real)0.25 : 0;
}

/* Events are recorded at the zeros of an oscillator. */
static void test_recorded_events(int fixed)
{
    const eom_model m = { .kind = BALL, .restitution = 1 };
    run r;

    start_from_rest(&r, 1000, 1, fixed);
    CHECK(integrate(&r, 10, (real)1e-9, &m) == EOM_OK, r.output.t);
    CHECK(r.output.events == 3, (double)r.output.events);
    for (int n = 0; n < r.output.events; n++) {
        const real *const row = r.event_rows + (1 + 2*NQ)*n;

        CHECK(r.which[n] == 1, r.which[n]);
        CHECK(eom_fabs(row[0] - ((real)n + (real)0.5)*PI) <= (real)1e-8, row[0]);
        CHECK(eom_fabs(row[2]) <= (real)1e-10, row[2]);
    }
}

/* A run stops at an event. */
static void test_stop(int fixed)
{
    const eom_model m = { .kind = BALL, .restitution = 1, .stop = (real)1.7 };
    run r;

    start_from_rest(&r, 1000, 1, fixed);
    CHECK(integrate(&r, 10, (real)1e-9, &m) == EOM_OK, r.output.t);
    CHECK(r.output.stopped == 3, r.output.stopped);
    CHECK(eom_fabs(r.output.t - (real)1.7) <= 8*EOM_EPS, r.output.t);
    CHECK(eom_fabs(r.q[1] - (real)cos(1.7)) <= (real)1e-8, r.q[1]);
}

/* Impacts that follow one another ever sooner (Zeno behaviour) end the run where they accumulate. */
static void test_accumulation(int fixed)
{
    const real e = (real)0.8;
    const eom_model m = { .kind = BALL, .restitution = e };
    real time = 1, interval = 2*e; /* of a fall from 5 m */
    int impacts = 0;
    run r;

    start_from_rest(&r, 5, 100, fixed);
    CHECK(integrate(&r, 20, (real)1e-9, &m) == EOM_ACCUMULATED, r.output.t);
    for (int n = 0; n < r.output.events; n++) {
        const real *const row = r.event_rows + (1 + 2*NQ)*n;

        if (r.which[n] != 0)
            continue;
        if (impacts++ < 20)
            CHECK(eom_fabs(row[0] - time) <= (real)1e-12*time, row[0] - time);
        time += interval;
        interval *= e;
    }
    CHECK(impacts > 100, impacts);
    CHECK(eom_fabs(r.output.limit - (1 + 2*e/(1 - e))) <= (real)1e-10, r.output.limit);
    CHECK(r.q[0] >= -(real)1e-12 && r.q[0] <= (real)1e-6, r.q[0]);
}

int main(void)
{
#if EOM_ADAPTIVE
    const int first = 0;
#else
    const int first = 1;
#endif

    test_series();
    test_roots();
    for (int fixed = first; fixed < 2; fixed++) {
        test_recorded_events(fixed);
        test_stop(fixed);
        test_accumulation(fixed);
    }
    return failures;
}
