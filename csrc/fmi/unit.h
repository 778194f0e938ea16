/*
 * A scene as a functional mock-up unit of FMI 2.0 or 3.0: variables, steps, events, derivatives.
 *
 * Value references number the variables, each a double for the importer: time, q, qd, their
 * derivatives, inputs, outputs, parameters, energies, event indicators. A Unit contains all variable
 * data; a copy of it is a state. There are no globals. This file is written by hand; scene.h is
 * generated. Names here have no underscore, which all names of a scene have.
 */
#ifndef FMU_UNIT_H
#define FMU_UNIT_H

#include "scene.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum {
    unitTime, /* value references, in the order of modelDescription.xml */
    unitQ,
    unitQd = unitQ + unitNQ,
    unitDerQ = unitQd + unitNQ,
    unitDerQd = unitDerQ + unitNQ,
    unitU = unitDerQd + unitNQ,
    unitY = unitU + unitNU,
    unitP = unitY + unitNY,
    unitE = unitP + unitNP,
    unitZ = unitE + 3,
    unitFollowSignals = unitZ + unitNE, /* Boolean: the scene's signals replace the inputs */
    unitNX = 2*unitNQ
};

typedef enum {
    unitNew,
    unitStarting,
    unitAtEvent,
    unitContinuous,
    unitStepping,
    unitEnded
} UnitMode;

/* Result of a call. */
typedef enum { unitOk, unitImpossible, unitRefused } UnitResult;

typedef struct {
    UnitMode mode;
    int exchange; /* 1: model exchange; 0: co-simulation */
    double t; /* time, s */
    double origin; /* the next step of fixed size starts at origin + steps*unitStep */
    long steps;
    unitReal q[unitNQ], qd[unitNQ], u[unitNU + 1];
    unitParameters p;
    char own[2*unitNQ]; /* whether the importer has set the initial values of q, then of qd */
    int signals; /* whether the scene's signals replace the inputs */
    double tolerance;
    int stopped; /* 1 + the event that stopped the motion; 0: none */
    int side[unitNE + 1]; /* model exchange: sign of each event indicator; 0: unknown */
    unitReal zero[unitNE + 1]; /* value that counts as zero: the indicator after a jump at its root */
    unitMemory memory;
} Unit;

typedef struct {
    Unit x;
    char message[240]; /* the last message */
} UnitInstance;

typedef void (*UnitEventCallback)(void *who, const char *text); /* called for each event */

/* Initialise the state of a new unit. */
static void unitReset(Unit *x, int exchange)
{
    const unitReal none[unitNU + 1] = { 0 };

    memset(x, 0, sizeof *x);
    x->exchange = exchange;
    x->tolerance = unitTolerance;
    unitDefaults(x->q, x->qd, &x->p);
    memcpy(x->u, none, sizeof none);
    unitInputDefaults(x->u);
}

static UnitResult unitSay(UnitInstance *a, UnitResult result, const char *text)
{
    snprintf(a->message, sizeof a->message, "at t = %.9g s: %s", a->x.t, text);
    return result;
}

/* Set the message for a status of the scene's functions. */
static UnitResult unitFailed(UnitInstance *a, int status)
{
    static const char *const words[] = {
        "D is not positive definite there, so no acceleration exists",
        ("the state would no longer be finite: the step may be too long, or the motion runs into "
         "a singularity"),
        "the iteration for the step does not converge: take a smaller step or a looser tolerance",
        "jumps follow one another ever sooner, without end in finite time",
        ("no state near obeys the constraints: they contradict one another there, or the step is "
         "far too long")
    };

    return unitSay(a, unitImpossible, words[status < 1 || status > 5 ? 1 : status - 1]);
}

/* The argument u of the scene's functions: NULL if its signals replace the inputs. */
static const unitReal *unitInputs(const Unit *x)
{
    return x->signals ? NULL : x->u;
}

/* Thresholds; macros, since none may be an unused object in some scene. */
#define unitLeftZero 100 /* an indicator of that many times its value after a jump has left its root */
#define unitRounding 1e-10 /* relative change of an indicator by a jump below which it is rounding */
#define unitTimeSlack 1e-9 /* relative difference of times that counts as rounding by the importer */
#define unitMaxCalls 1000 /* of 10,000 steps each, in a communication step */
#define unitMaxSteps 1e9 /* of fixed size in a communication step: a C long may have 32 bits */

/* --- variables ---------------------------------------------------------------------------------- */

/* Values that are computed at most once in a call, and whether they have been. */
typedef struct {
    int accelerations, outputs, energies, indicators, signals;
    unitReal qdd[unitNQ], y[unitNY + 1], e[3], z[unitNE + 1], u[unitNU + 1];
} UnitValues;

static void unitIndicate(const Unit *x, unitReal *z)
{
    unitEvents(z, x->q, x->qd, (unitReal)x->t, unitInputs(x), &x->p);
    for (int k = 0; k < unitNE; k++)
        z[k] -= x->zero[k];
}

static UnitResult unitAccelerate(UnitInstance *a, UnitValues *v)
{
    const Unit *const x = &a->x;
    const int status = v->accelerations
        ? 0
        : unitAcceleration(v->qdd, x->q, x->qd, (unitReal)x->t, unitInputs(x), &x->p);

    v->accelerations = !status;
    return status ? unitFailed(a, status) : unitOk;
}

static UnitResult unitGet(UnitInstance *a, unsigned reference, UnitValues *v, double *value)
{
    const Unit *const x = &a->x;
    const unitReal t = (unitReal)x->t, *const u = unitInputs(x);
    const long r = (long)reference;
    int status = 0;

    *value = 0;
    if (r == unitTime) {
        *value = x->t;
    } else if (r < unitQd) {
        *value = (double)x->q[r - unitQ];
    } else if (r < unitDerQ) {
        *value = (double)x->qd[r - unitQd];
    } else if (r < unitDerQd) {
        *value = (double)x->qd[r - unitDerQ];
    } else if (r < unitU) {
        if (unitAccelerate(a, v))
            return unitImpossible;
        *value = (double)v->qdd[r - unitDerQd];
    } else if (r < unitY) {
        if (x->signals && !v->signals)
            unitSignals(v->u, x->q, x->qd, t, &x->p);
        v->signals = 1;
        *value = (double)(x->signals ? v->u : x->u)[r - unitU];
    } else if (r < unitP) {
        if (!v->outputs)
            status = unitOutputs(v->y, x->q, x->qd, t, u, &x->p);
        if (status)
            return unitFailed(a, status);
        v->outputs = 1;
        *value = (double)v->y[r - unitY];
    } else if (r < unitE) {
        unitParameters p = x->p;

        *value = (double)*unitParameter(&p, (int)(r - unitP));
    } else if (r < unitZ) {
        if (!v->energies)
            unitEnergies(v->e, x->q, x->qd, t, &x->p);
        v->energies = 1;
        *value = (double)v->e[r - unitE];
    } else if (r < unitFollowSignals) {
        if (!v->indicators)
            unitIndicate(x, v->z);
        v->indicators = 1;
        *value = (double)v->z[r - unitZ];
    } else {
        snprintf(a->message, sizeof a->message,
            "there is no real variable of the value reference %u",
            reference);
        return unitRefused;
    }
    if (!(*value - *value == 0))
        return unitFailed(a, 2);
    return unitOk;
}

static UnitResult unitSet(UnitInstance *a, unsigned reference, double value)
{
    Unit *const x = &a->x;
    const long r = (long)reference;
    const unitReal number = (unitReal)value;
    /* in model exchange the importer integrates, and may set the state at any time */
    const int free = x->exchange || x->mode == unitNew || x->mode == unitStarting;

    if (!(number - number == 0)) {
        snprintf(a->message, sizeof a->message,
            "the variable of the value reference %u can't be set to %g", reference, value);
        return unitRefused;
    }
    if (r >= unitU && r < unitY) {
        x->u[r - unitU] = number;
    } else if (r >= unitP && r < unitE) {
        *unitParameter(&x->p, (int)(r - unitP)) = number;
        if (x->mode == unitNew || x->mode == unitStarting)
            unitStarts(x->q, x->qd, x->own, &x->p);
    } else if (r >= unitQ && r < unitDerQ) {
        if (!free)
            return unitSay(a, unitRefused,
                "in co-simulation coordinates and velocities can be set until its start only");
        *(r < unitQd ? &x->q[r - unitQ] : &x->qd[r - unitQd]) = number;
        x->own[r - unitQ] = 1;
    } else {
        snprintf(a->message, sizeof a->message,
            "the variable of the value reference %u is calculated and can't be set", reference);
        return unitRefused;
    }
    return unitOk;
}

/* --- model exchange ----------------------------------------------------------------------------- */

static void unitTake(const Unit *x, double *state)
{
    for (int i = 0; i < unitNQ; i++) {
        state[i] = (double)x->q[i];
        state[unitNQ + i] = (double)x->qd[i];
    }
}

static void unitPut(Unit *x, const double *state)
{
    for (int i = 0; i < unitNQ; i++) {
        x->q[i] = (unitReal)state[i];
        x->qd[i] = (unitReal)state[unitNQ + i];
    }
}

/* [qd; qdd]. */
static UnitResult unitDerivatives(UnitInstance *a, double *derivatives)
{
    UnitValues v = { 0 };

    if (unitAccelerate(a, &v))
        return unitImpossible;
    for (int i = 0; i < unitNQ; i++) {
        derivatives[i] = (double)a->x.qd[i];
        derivatives[unitNQ + i] = (double)v.qdd[i];
    }
    return unitOk;
}

static UnitResult unitIndicators(UnitInstance *a, double *indicators)
{
    unitReal z[unitNE + 1];

    unitIndicate(&a->x, z);
    for (int k = 0; k < unitNE; k++) {
        if (!(z[k] - z[k] == 0))
            return unitFailed(a, 2);
        indicators[k] = (double)z[k];
    }
    return unitOk;
}

static int unitSign(unitReal z)
{
    return (z > 0) - (z < 0);
}

/*
 * Return whether an event indicator has changed its sign since the last call. The signs of indicators
 * that were zero are stored.
 */
static int unitCrossed(Unit *x)
{
    unitReal z[unitNE + 1];
    int crossed = 0;

    unitIndicate(x, z);
    for (int k = 0; k < unitNE; k++) {
        if (x->side[k] == 0)
            x->side[k] = unitSign(z[k]);
        else
            crossed |= x->side[k]*unitSign(z[k]) < 0;
        if (fabs((double)z[k]) > unitLeftZero*fabs((double)x->zero[k]))
            x->zero[k] = 0;
    }
    return crossed;
}

/*
 * Process the events whose indicators have reached or crossed zero, in the scene's order. A jump
 * changes the state for the events after it; a change of an indicator's sign by a jump is no event.
 * *jumped = whether the state has changed.
 */
static UnitResult unitHappen(UnitInstance *a, int *jumped, UnitEventCallback report, void *who)
{
    Unit *const x = &a->x;
    char text[160];
    unitReal z[unitNE + 1], after[unitNE*unitNX + 1], indicators[unitNE + 1];

    *jumped = 0;
    unitIndicate(x, z);
    for (int k = 0; k < unitNE; k++) {
        const int side = x->side[k];

        if (side == 0 || side*unitSign(z[k]) > 0)
            continue;
        x->side[k] = unitSign(z[k]);
        if (unitDirection(k)*side > 0) /* opposite direction */
            continue;
        snprintf(text, sizeof text, "event '%s' at t = %.12g s", unitEventName(k), x->t);
        report(who, text);
        if (unitAction(k) == 1)
            x->stopped = k + 1;
        if (unitAction(k) != 2)
            continue;
        unitJumps(after, x->q, x->qd, (unitReal)x->t, unitInputs(x), &x->p);
        for (int i = 0; i < unitNX; i++)
            if (!(after[unitNX*k + i] - after[unitNX*k + i] == 0)) {
                snprintf(a->message, sizeof a->message,
                    "at t = %.9g s: event '%s' jumps to no finite state", x->t, unitEventName(k));
                return unitImpossible;
            }
        for (int i = 0; i < unitNQ; i++) {
            x->q[i] = after[unitNX*k + i];
            x->qd[i] = after[unitNX*k + unitNQ + i];
        }
        *jumped = 1;
        unitIndicate(x, indicators);
        for (int i = 0; i < unitNE; i++) {
            const double change = fabs((double)(indicators[i] - z[i]));
            const double size = fabs((double)indicators[i]) + fabs((double)z[i]);

            if (change > unitRounding*size) {
                x->side[i] = unitSign(indicators[i] + x->zero[i]);
                x->zero[i] = 0;
            } else if (i == k) { /* at its root, which it leaves */
                x->side[k] = 0;
                x->zero[k] += indicators[k];
            }
        }
        unitIndicate(x, z);
    }
    return unitOk;
}

/* --- co-simulation ------------------------------------------------------------------------------ */

#if unitAdaptive

/* Advance to t_end, or until an event stops the motion. */
static UnitResult unitAdvance(UnitInstance *a, double t_end, UnitEventCallback report, void *who)
{
    Unit *const x = &a->x;

    for (int calls = 0; x->t < t_end && !x->stopped; calls++) {
        unitReal t = (unitReal)x->t, when[unitRoom];
        int which[unitRoom];
        long count = 0;
        const int status = unitAdapt(x->q, x->qd, &t, (unitReal)t_end, (unitReal)x->tolerance,
            unitInputs(x), &count, which, when, &x->p, &x->memory);

        x->t = t < (unitReal)t_end ? (double)t : t_end;
        for (long n = 0; n < count; n++) {
            char text[160];

            snprintf(text, sizeof text, "event '%s' at t = %.12g s", unitEventName(which[n]),
                (double)when[n]);
            report(who, text);
        }
        if (status)
            return unitFailed(a, status);
        x->stopped = unitStopped(&x->memory);
        if (calls > unitMaxCalls)
            return unitSay(
                a, unitImpossible, "no end after 10,000,000 steps: take a looser tolerance");
    }
    return unitOk;
}

#else

/*
 * Advance to t_end by steps of the scene's size from origin on, as a run of the scene makes them, and by
 * a shorter one if t_end lies between two of these; the next steps then start at t_end.
 */
static UnitResult unitAdvance(UnitInstance *a, double t_end, UnitEventCallback report, void *who)
{
    Unit *const x = &a->x;
    const double h = unitStep, slack = unitTimeSlack*h + 4*2.3e-16*(fabs(t_end) + fabs(x->origin));
    const double whole = floor((t_end - x->origin + slack)/h) - (double)x->steps;
    double rest;
    int status = 0;

    (void)report, (void)who;
    if (whole > unitMaxSteps)
        return unitSay(
            a, unitRefused, "a communication step has more than 1e9 steps of the scene's size");
    if (whole > 0) {
        const long completed = unitRun(x->q, x->qd, (unitReal)x->origin, x->steps, (long)whole,
            unitInputs(x), &x->p, &x->memory, &status);

        x->steps += completed;
        x->t = x->origin + (double)x->steps*h;
        if (status)
            return unitFailed(a, status);
    }
    rest = t_end - (x->origin + (double)x->steps*h);
    if (rest > slack) {
        status = unitOneStep(
            x->q, x->qd, (unitReal)(t_end - rest), (unitReal)rest, unitInputs(x), &x->p);
        if (status)
            return unitFailed(a, status);
        memset(&x->memory, 0, sizeof x->memory);
        x->origin = t_end;
        x->steps = 0;
    }
    x->t = t_end;
    return unitOk;
}

#endif

/* A communication step. */
static UnitResult unitCommunicate(
    UnitInstance *a, double t, double size, UnitEventCallback report, void *who)
{
    const Unit *const x = &a->x;

    if (x->mode != unitStepping)
        return unitSay(a, unitRefused, "a step is for co-simulation, after initialization");
    if (!(size >= 0 && size - size == 0))
        return unitSay(a, unitRefused, "a communication step has a size of zero or more");
    if (!(fabs(t - x->t) <= unitTimeSlack*(fabs(t) + size)) && !x->stopped)
        return unitSay(a, unitRefused, "a communication step begins where the last one ended");
    return unitAdvance(a, t + size, report, who);
}

/* --- derivatives -------------------------------------------------------------------------------- */

/*
 * sensitivities = d(unknowns)/d(knowns) seeds, where everything else is constant. Knowns are
 * coordinates, velocities, inputs and, where the scene has such derivatives, parameters; unknowns are
 * coordinates, velocities, their derivatives and outputs.
 */
static UnitResult unitSlope(UnitInstance *a, const unsigned *unknowns, size_t unknownCount,
    const unsigned *knowns, size_t knownCount, const double *seeds, double *sensitivities)
{
    const Unit *const x = &a->x;
    const unitReal t = (unitReal)x->t, *const u = unitInputs(x);
    double along[unitNX + unitNU + 1] = { 0 }, change[unitNP + 1] = { 0 }, rates[unitNQ];
    unitReal Aq[unitNQ*unitNQ], Aqd[unitNQ*unitNQ], B[unitNQ*unitNU + 1], E[unitNQ*unitNP + 1] = { 0 },
        slopes[unitNY*(3*unitNQ + unitNU) + 1], parametric[unitNY*unitNP + 1] = { 0 };
    int status, parameters = 0;

    if (!unitLinearized)
        return unitSay(a, unitRefused,
            "there are no derivatives: [run] linearize = true of the scene brings them");
    if (x->signals && unitFeedback)
        return unitSay(a, unitRefused,
            "there are no derivatives while signals answer the state: inputs are constant in them");
    for (size_t k = 0; k < knownCount; k++) {
        const long r = (long)knowns[k];

        if (r >= unitQ && r < unitDerQ)
            along[r - unitQ] += seeds[k];
        else if (r >= unitU && r < unitY)
            along[unitNX + r - unitU] += x->signals ? 0 : seeds[k];
        else if (r >= unitP && r < unitE) {
            change[r - unitP] += seeds[k];
            parameters = 1;
        } else
            return unitSay(a, unitRefused,
                "there are derivatives with respect to coordinates, velocities, inputs and parameters "
                "only");
    }
    if (parameters && !unitSensitive)
        return unitSay(a, unitRefused,
            "there are no derivatives with respect to parameters: [run] linearize = \"parameters\" of "
            "the scene adds them");
    if (parameters && x->signals && unitSignalParameters)
        return unitSay(a, unitRefused,
            "there are no derivatives with respect to parameters while signals depend on parameters: "
            "inputs are constant in them");
    status = unitLinearize(Aq, Aqd, B, x->q, x->qd, t, u, &x->p);
    if (!status)
        status = unitOutputSlopes(slopes, x->q, x->qd, t, u, &x->p);
    if (!status && parameters) {
        unitSensitivity(E, x->q, x->qd, t, u, &x->p);
        status = unitOutputSensitivity(parametric, x->q, x->qd, t, u, &x->p);
    }
    if (status)
        return unitFailed(a, status);
    for (int i = 0; i < unitNQ; i++) {
        double sum = 0;

        for (int j = 0; j < unitNQ; j++)
            sum += (double)Aq[unitNQ*i + j]*along[j] +
                (double)Aqd[unitNQ*i + j]*along[unitNQ + j];
        for (int j = 0; j < unitNU; j++)
            sum += (double)B[unitNU*i + j]*along[unitNX + j];
        for (int j = 0; parameters && j < unitNP; j++)
            sum += (double)E[unitNP*i + j]*change[j];
        rates[i] = sum;
    }
    for (size_t k = 0; k < unknownCount; k++) {
        const long r = (long)unknowns[k];
        double sum = 0;

        if (r >= unitQ && r < unitDerQ) {
            sum = along[r - unitQ];
        } else if (r >= unitDerQ && r < unitDerQd) {
            sum = along[unitNQ + r - unitDerQ];
        } else if (r >= unitDerQd && r < unitU) {
            sum = rates[r - unitDerQd];
        } else if (r >= unitY && r < unitP) {
            const unitReal *const row = slopes + (r - unitY)*(3*unitNQ + unitNU);

            for (int j = 0; j < unitNX + unitNU; j++)
                sum += (double)row[j]*along[j];
            for (int j = 0; j < unitNQ; j++)
                sum += (double)row[unitNX + unitNU + j]*rates[j];
            for (int j = 0; parameters && j < unitNP; j++)
                sum += (double)parametric[unitNP*(r - unitY) + j]*change[j];
        } else {
            return unitSay(a, unitRefused,
                "there are derivatives of coordinates, velocities, accelerations and outputs only");
        }
        if (!(sum - sum == 0))
            return unitSay(a, unitImpossible, "a derivative is not finite there");
        sensitivities[k] = sum;
    }
    return unitOk;
}

/* --- states ------------------------------------------------------------------------------------- */

enum { unitBytes = 8 + sizeof(Unit) }; /* a serialized state: stamp of the unit, size, state */

static void unitPack(const Unit *x, unsigned char *bytes)
{
    const unsigned long head[2] = { unitStamp, sizeof(Unit) };

    for (int i = 0; i < 8; i++)
        bytes[i] = (unsigned char)(head[i/4] >> 8*(i % 4) & 255);
    memcpy(bytes + 8, x, sizeof *x);
}

static UnitResult unitUnpack(UnitInstance *a, const unsigned char *bytes, size_t size, Unit *x)
{
    const unsigned long head[2] = { unitStamp, sizeof(Unit) };
    int same = size == (size_t)unitBytes;

    for (int i = 0; same && i < 8; i++)
        same = bytes[i] == (unsigned char)(head[i/4] >> 8*(i % 4) & 255);
    if (!same)
        return unitSay(
            a, unitRefused, "these bytes are no state of this unit, or of another build of it");
    memcpy(x, bytes + 8, sizeof *x);
    return unitOk;
}

#endif
