/* FMI 2.0, model exchange and co-simulation, over unit.h. Written by hand, the same for every scene. */
#include "fmi2Functions.h"

/* The FMI header adds no prefix, which units that are linked statically need. */
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
    int errors, events; /* whether such messages are logged */
} Instance;

/* text: without '%', since loggers may use it as a format. */
static void log_message(const Instance *a, fmi2Status status, const char *category, const char *text)
{
    if (a->callbacks.logger && (status == fmi2OK ? a->events : a->errors))
        a->callbacks.logger(a->callbacks.componentEnvironment, a->name, status, category, text);
}

#define FMI(name) fmi2##name
#define FMI_TEXT(name) "fmi2" #name
#define FMI_STATE(prefix, suffix) fmi2##prefix##FMUstate##suffix
#define FMI_DESERIALIZE fmi2DeSerializeFMUstate
#define FMI_INSTANCE fmi2Component
#include "both.h"

/* --- instances ---------------------------------------------------------------------------------- */

const char *fmi2GetTypesPlatform(void)
{
    return fmi2TypesPlatform;
}

const char *fmi2GetVersion(void)
{
    return fmi2Version;
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
    if (unitConstrained && fmuType == fmi2ModelExchange) {
        if (functions->logger)
            functions->logger(functions->componentEnvironment, instanceName, fmi2Error,
                "logStatusError", "there is no model exchange: constraints hold in co-simulation");
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
    a->errors = 1; /* failures are logged unless fmi2SetDebugLogging disables that */
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

/* --- variables ---------------------------------------------------------------------------------- */

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2Real value[])
{
    return get(c, vr, nvr, value);
}

fmi2Status fmi2SetReal(
    fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2Real value[])
{
    return set(c, vr, nvr, value);
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

/* Types that no variable has: calls without value references succeed. */
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

fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *fmi2eventInfo)
{
    Instance *const a = c;
    int jumped = 0;
    const UnitResult result = unitHappen(&a->unit, &jumped, log_event, a);

    memset(fmi2eventInfo, 0, sizeof *fmi2eventInfo);
    fmi2eventInfo->terminateSimulation = a->unit.x.stopped != 0;
    fmi2eventInfo->valuesOfContinuousStatesChanged = jumped;
    return outcome(a, result);
}

fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real values[], size_t nx)
{
    return derivatives(c, values, nx);
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

/* fmi2Discard if an event has stopped the motion or it cannot continue; fmi2GetRealStatus returns the time. */
fmi2Status fmi2DoStep(fmi2Component c, fmi2Real currentCommunicationPoint,
    fmi2Real communicationStepSize, fmi2Boolean noSetFMUStatePriorToCurrentPoint)
{
    Instance *const a = c;
    const UnitResult result =
        unitCommunicate(&a->unit, currentCommunicationPoint, communicationStepSize, log_event, a);

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
