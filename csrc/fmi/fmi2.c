/* FMI 2.0, model exchange and co-simulation, over unit.h. Written by hand, the same for every scene. */
#include "fmi2Functions.h"

/* The header beside this file adds no prefix: units that are linked statically want one. */
#if defined(FMI2_FUNCTION_PREFIX) && !defined(FMI2_OVERRIDE_FUNCTION_PREFIX)
#undef fmi2FullName
#define fmi2Paste(a, b) a##b
#define fmi2PasteB(a, b) fmi2Paste(a, b)
#define fmi2FullName(name) fmi2PasteB(FMI2_FUNCTION_PREFIX, name)
#endif

#include "unit.h"

typedef struct {
    UnitInstance unit;
    fmi2CallbackFunctions callbacks;
    char *name;
    int errors, events; /* which messages are wanted */
} Instance;

/* text: without a '%', since loggers take it for a format. */
static void said(const Instance *a, fmi2Status status, const char *category, const char *text)
{
    if (a->callbacks.logger && (status == fmi2OK ? a->events : a->errors))
        a->callbacks.logger(a->callbacks.componentEnvironment, a->name, status, category, text);
}

static fmi2Status outcome(Instance *a, UnitResult result)
{
    if (result == unitOk)
        return fmi2OK;
    if (result == unitImpossible) {
        said(a, fmi2Discard, "logStatusDiscard", a->unit.said);
        return fmi2Discard;
    }
    said(a, fmi2Error, "logStatusError", a->unit.said);
    return fmi2Error;
}

static fmi2Status refused(Instance *a, const char *text)
{
    return outcome(a, unitSay(&a->unit, unitRefused, text));
}

static void happened(void *instance, const char *text)
{
    const Instance *const a = instance;

    said(a, fmi2OK, "logEvents", text);
}

static fmi2Status enter(Instance *a, UnitMode from, UnitMode to, const char *call)
{
    if (a->unit.x.mode != from) {
        snprintf(
            a->unit.said, sizeof a->unit.said, "%s is not for the mode that the unit is in", call);
        return outcome(a, unitRefused);
    }
    a->unit.x.mode = to;
    return fmi2OK;
}

/* --- instances ---------------------------------------------------------------------------------- */

const char *fmi2GetTypesPlatform(void)
{
    return fmi2TypesPlatform;
}

const char *fmi2GetVersion(void)
{
    return fmi2Version;
}

fmi2Status fmi2SetDebugLogging(
    fmi2Component c, fmi2Boolean loggingOn, size_t nCategories, const fmi2String categories[])
{
    Instance *const a = c;

    if (nCategories == 0)
        a->errors = a->events = loggingOn;
    for (size_t i = 0; i < nCategories; i++) {
        if (!strcmp(categories[i], "logEvents"))
            a->events = loggingOn;
        else if (!strcmp(categories[i], "logStatusError") ||
            !strcmp(categories[i], "logStatusDiscard"))
            a->errors = loggingOn;
        else
            return refused(a,
                "there is no such category of messages: logEvents, logStatusDiscard, "
                "logStatusError");
    }
    return fmi2OK;
}

fmi2Component fmi2Instantiate(fmi2String instanceName, fmi2Type fmuType, fmi2String fmuGUID,
    fmi2String fmuResourceLocation, const fmi2CallbackFunctions *functions, fmi2Boolean visible,
    fmi2Boolean loggingOn)
{
    Instance *a;
    size_t length;

    (void)fmuResourceLocation, (void)visible;
    if (!functions)
        return NULL;
    if (!instanceName)
        instanceName = "";
    if (!fmuGUID || strcmp(fmuGUID, unitToken)) {
        if (functions->logger)
            functions->logger(functions->componentEnvironment, instanceName, fmi2Error,
                "logStatusError",
                "the GUID is not that of this unit: modelDescription.xml and binary are of "
                "different builds");
        return NULL;
    }
    length = strlen(instanceName) + 1;
    a = calloc(1, sizeof *a);
    if (a)
        a->name = malloc(length);
    if (!a || !a->name) {
        free(a);
        if (functions->logger)
            functions->logger(functions->componentEnvironment, instanceName, fmi2Error,
                "logStatusError", "there is no memory for an instance");
        return NULL;
    }
    memcpy(a->name, instanceName, length);
    a->callbacks = *functions;
    a->errors = 1; /* failures are always told, unless fmi2SetDebugLogging says otherwise */
    a->events = loggingOn;
    unitReset(&a->unit.x, fmuType == fmi2ModelExchange);
    return a;
}

void fmi2FreeInstance(fmi2Component c)
{
    Instance *const a = c;

    if (a)
        free(a->name);
    free(a);
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean toleranceDefined, fmi2Real tolerance,
    fmi2Real startTime, fmi2Boolean stopTimeDefined, fmi2Real stopTime)
{
    Instance *const a = c;

    (void)stopTimeDefined, (void)stopTime;
    if (a->unit.x.mode != unitNew)
        return refused(a, "fmi2SetupExperiment comes before initialization");
    a->unit.x.t = a->unit.x.origin = startTime;
    if (toleranceDefined)
        a->unit.x.tolerance = tolerance;
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c)
{
    return enter(c, unitNew, unitStarting, "fmi2EnterInitializationMode");
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
    Instance *const a = c;
    const fmi2Status status = enter(a, unitStarting,
        a->unit.x.exchange ? unitAtEvent : unitStepping, "fmi2ExitInitializationMode");

    if (status == fmi2OK)
        (void)unitCrossed(&a->unit.x);
    return status;
}

fmi2Status fmi2Terminate(fmi2Component c)
{
    Instance *const a = c;

    a->unit.x.mode = unitEnded;
    return fmi2OK;
}

fmi2Status fmi2Reset(fmi2Component c)
{
    Instance *const a = c;

    unitReset(&a->unit.x, a->unit.x.exchange);
    return fmi2OK;
}

/* --- variables ---------------------------------------------------------------------------------- */

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2Real value[])
{
    Instance *const a = c;
    UnitValues v = { 0 };
    UnitResult result = unitOk;

    for (size_t i = 0; i < nvr && result == unitOk; i++)
        result = unitGet(&a->unit, vr[i], &v, &value[i]);
    return outcome(a, result);
}

fmi2Status fmi2SetReal(
    fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2Real value[])
{
    Instance *const a = c;
    UnitResult result = unitOk;

    for (size_t i = 0; i < nvr && result == unitOk; i++)
        result = unitSet(&a->unit, vr[i], value[i]);
    return outcome(a, result);
}

fmi2Status fmi2GetBoolean(
    fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2Boolean value[])
{
    Instance *const a = c;

    for (size_t i = 0; i < nvr; i++) {
        if (vr[i] != unitFollowSignals)
            return refused(a, "there is no Boolean variable of this value reference");
        value[i] = a->unit.x.signals;
    }
    return fmi2OK;
}

fmi2Status fmi2SetBoolean(
    fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2Boolean value[])
{
    Instance *const a = c;

    for (size_t i = 0; i < nvr; i++) {
        if (vr[i] != unitFollowSignals)
            return refused(a, "there is no Boolean variable of this value reference");
        a->unit.x.signals = value[i] != 0;
    }
    return fmi2OK;
}

/* Types that no variable has: fine where nothing is asked for. */
#define NONE(name, values)                                                                    \
    fmi2Status fmi2##name(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, values) \
    {                                                                                         \
        (void)vr, (void)unused;                                                               \
        return nvr ? refused(c, "there are no variables of this type: fmi2" #name) : fmi2OK;  \
    }

NONE(GetInteger, fmi2Integer unused[])
NONE(GetString, fmi2String unused[])
NONE(SetInteger, const fmi2Integer unused[])
NONE(SetString, const fmi2String unused[])

/* --- states ------------------------------------------------------------------------------------- */

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *FMUstate)
{
    Instance *const a = c;

    if (!*FMUstate)
        *FMUstate = malloc(sizeof a->unit.x);
    if (!*FMUstate)
        return refused(a, "there is no memory for a state");
    memcpy(*FMUstate, &a->unit.x, sizeof a->unit.x);
    return fmi2OK;
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate FMUstate)
{
    Instance *const a = c;

    if (!FMUstate)
        return refused(a, "fmi2SetFMUstate: there is no state");
    memcpy(&a->unit.x, FMUstate, sizeof a->unit.x);
    return fmi2OK;
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *FMUstate)
{
    (void)c;
    if (FMUstate) {
        free(*FMUstate);
        *FMUstate = NULL;
    }
    return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate FMUstate, size_t *size)
{
    (void)c, (void)FMUstate;
    *size = (size_t)unitBytes;
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(
    fmi2Component c, fmi2FMUstate FMUstate, fmi2Byte serializedState[], size_t size)
{
    if (!FMUstate || size < (size_t)unitBytes)
        return refused(c,
            "fmi2SerializeFMUstate: there is no state, or not as much room as "
            "fmi2SerializedFMUstateSize tells");
    unitPack(FMUstate, (unsigned char *)serializedState);
    return fmi2OK;
}

fmi2Status fmi2DeSerializeFMUstate(
    fmi2Component c, const fmi2Byte serializedState[], size_t size, fmi2FMUstate *FMUstate)
{
    Instance *const a = c;
    Unit x;
    const UnitResult result =
        unitUnpack(&a->unit, (const unsigned char *)serializedState, size, &x);

    if (result)
        return outcome(a, result);
    if (!*FMUstate)
        *FMUstate = malloc(sizeof x);
    if (!*FMUstate)
        return refused(a, "there is no memory for a state");
    memcpy(*FMUstate, &x, sizeof x);
    return fmi2OK;
}

/* --- derivatives -------------------------------------------------------------------------------- */

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference vUnknown_ref[],
    size_t nUnknown, const fmi2ValueReference vKnown_ref[], size_t nKnown, const fmi2Real dvKnown[],
    fmi2Real dvUnknown[])
{
    Instance *const a = c;

    return outcome(
        a, unitSlope(&a->unit, vUnknown_ref, nUnknown, vKnown_ref, nKnown, dvKnown, dvUnknown));
}

/* --- model exchange ----------------------------------------------------------------------------- */

fmi2Status fmi2EnterEventMode(fmi2Component c)
{
    return enter(c, unitContinuous, unitAtEvent, "fmi2EnterEventMode");
}

fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c)
{
    return enter(c, unitAtEvent, unitContinuous, "fmi2EnterContinuousTimeMode");
}

fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *fmi2eventInfo)
{
    Instance *const a = c;
    int jumped = 0;
    const UnitResult result = unitHappen(&a->unit, &jumped, happened, a);

    memset(fmi2eventInfo, 0, sizeof *fmi2eventInfo);
    fmi2eventInfo->terminateSimulation = a->unit.x.stopped != 0;
    fmi2eventInfo->valuesOfContinuousStatesChanged = jumped;
    return outcome(a, result);
}

fmi2Status fmi2CompletedIntegratorStep(fmi2Component c,
    fmi2Boolean noSetFMUStatePriorToCurrentPoint, fmi2Boolean *enterEventMode,
    fmi2Boolean *terminateSimulation)
{
    Instance *const a = c;

    (void)noSetFMUStatePriorToCurrentPoint;
    *enterEventMode = unitCrossed(&a->unit.x);
    *terminateSimulation = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2SetTime(fmi2Component c, fmi2Real time)
{
    Instance *const a = c;

    a->unit.x.t = time;
    return fmi2OK;
}

fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t nx)
{
    Instance *const a = c;

    if (nx != (size_t)unitNX)
        return refused(
            a, "fmi2SetContinuousStates: coordinates and velocities, no more and no less");
    unitPut(&a->unit.x, x);
    return fmi2OK;
}

fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t nx)
{
    Instance *const a = c;

    if (nx != (size_t)unitNX)
        return refused(
            a, "fmi2GetContinuousStates: coordinates and velocities, no more and no less");
    unitTake(&a->unit.x, x);
    return fmi2OK;
}

fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real derivatives[], size_t nx)
{
    Instance *const a = c;

    if (nx != (size_t)unitNX)
        return refused(a, "fmi2GetDerivatives: of coordinates and velocities, no more and no less");
    return outcome(a, unitDerivatives(&a->unit, derivatives));
}

fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real eventIndicators[], size_t ni)
{
    Instance *const a = c;

    if (ni != (size_t)unitNE)
        return refused(a, "fmi2GetEventIndicators: one for each event");
    return outcome(a, unitIndicators(&a->unit, eventIndicators));
}

fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real x_nominal[], size_t nx)
{
    (void)c;
    for (size_t i = 0; i < nx; i++)
        x_nominal[i] = 1;
    return fmi2OK;
}

/* --- co-simulation ------------------------------------------------------------------------------ */

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
    const fmi2Integer order[], const fmi2Real value[])
{
    (void)vr, (void)nvr, (void)order, (void)value;
    return refused(
        c, "inputs are held over a communication step: there are no derivatives of them");
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
    const fmi2Integer order[], fmi2Real value[])
{
    (void)vr, (void)nvr, (void)order, (void)value;
    return refused(c, "there are no derivatives of outputs by time");
}

/* Where an event has stopped the motion, or it can't go on: fmi2Discard, and fmi2GetRealStatus says when. */
fmi2Status fmi2DoStep(fmi2Component c, fmi2Real currentCommunicationPoint,
    fmi2Real communicationStepSize, fmi2Boolean noSetFMUStatePriorToCurrentPoint)
{
    Instance *const a = c;
    const UnitResult result =
        unitCommunicate(&a->unit, currentCommunicationPoint, communicationStepSize, happened, a);

    (void)noSetFMUStatePriorToCurrentPoint;
    return result == unitOk && a->unit.x.stopped ? fmi2Discard : outcome(a, result);
}

fmi2Status fmi2CancelStep(fmi2Component c)
{
    return refused(c, "steps end before they return: there is none to cancel");
}

fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind s, fmi2Status *value)
{
    (void)s, (void)value;
    return refused(
        c, "steps end before they return: fmi2GetRealStatus and fmi2GetBooleanStatus say how");
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind s, fmi2Real *value)
{
    Instance *const a = c;

    if (s != fmi2LastSuccessfulTime)
        return refused(a, "fmi2GetRealStatus: of fmi2LastSuccessfulTime");
    *value = a->unit.x.t;
    return fmi2OK;
}

fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind s, fmi2Integer *value)
{
    (void)s, (void)value;
    return refused(c, "there is no status that is an integer");
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind s, fmi2Boolean *value)
{
    Instance *const a = c;

    if (s != fmi2Terminated)
        return refused(a, "fmi2GetBooleanStatus: of fmi2Terminated");
    *value = a->unit.x.stopped != 0;
    return fmi2OK;
}

fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind s, fmi2String *value)
{
    (void)s, (void)value;
    return refused(c, "steps end before they return: there is none that is pending");
}
