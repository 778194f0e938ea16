/* FMI 3.0, model exchange and co-simulation, over unit.h. Written by hand, the same for every scene. */
#include "fmi3Functions.h"

#include "unit.h"

typedef struct {
    UnitInstance unit;
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
    bool errors, events; /* whether such messages are logged */
} Instance;

static void log_message(const Instance *a, fmi3Status status, const char *category, const char *text)
{
    if (a->log && (status == fmi3OK ? a->events : a->errors))
        a->log(a->environment, status, category, text);
}

#define FMI(name) fmi3##name
#define FMI_TEXT(name) "fmi3" #name
#define FMI_STATE(prefix, suffix) fmi3##prefix##FMUState##suffix
#define FMI_DESERIALIZE fmi3DeserializeFMUState
#define FMI_INSTANCE fmi3Instance
#include "both.h"

/* --- instances ---------------------------------------------------------------------------------- */

const char *fmi3GetVersion(void)
{
    return fmi3Version;
}

static fmi3Instance instantiate(fmi3String token, fmi3Boolean loggingOn,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log, int exchange)
{
    Instance *a;

    if (!token || strcmp(token, unitToken)) {
        if (log)
            log(environment, fmi3Error, "logStatusError",
                "the instantiation token is not that of this unit: modelDescription.xml and binary "
                "are of different builds");
        return NULL;
    }
    if (unitConstrained && exchange) {
        if (log)
            log(environment, fmi3Error, "logStatusError",
                "there is no model exchange: constraints hold in co-simulation");
        return NULL;
    }
    a = calloc(1, sizeof *a);
    if (!a) {
        if (log)
            log(environment, fmi3Error, "logStatusError", "there is no memory for an instance");
        return NULL;
    }
    a->environment = environment;
    a->log = log;
    a->errors = true; /* failures are logged unless fmi3SetDebugLogging disables that */
    a->events = loggingOn;
    unitReset(&a->unit.x, exchange);
    return a;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String instanceName, fmi3String instantiationToken,
    fmi3String resourcePath, fmi3Boolean visible, fmi3Boolean loggingOn,
    fmi3InstanceEnvironment instanceEnvironment, fmi3LogMessageCallback logMessage)
{
    (void)instanceName, (void)resourcePath, (void)visible;
    return instantiate(instantiationToken, loggingOn, instanceEnvironment, logMessage, 1);
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String instanceName, fmi3String instantiationToken,
    fmi3String resourcePath, fmi3Boolean visible, fmi3Boolean loggingOn, fmi3Boolean eventModeUsed,
    fmi3Boolean earlyReturnAllowed, const fmi3ValueReference requiredIntermediateVariables[],
    size_t nRequiredIntermediateVariables, fmi3InstanceEnvironment instanceEnvironment,
    fmi3LogMessageCallback logMessage, fmi3IntermediateUpdateCallback intermediateUpdate)
{
    (void)instanceName, (void)resourcePath, (void)visible, (void)eventModeUsed,
        (void)earlyReturnAllowed;
    (void)requiredIntermediateVariables, (void)intermediateUpdate;
    if (nRequiredIntermediateVariables) {
        if (logMessage)
            logMessage(instanceEnvironment, fmi3Error, "logStatusError",
                "there are no intermediate variables");
        return NULL;
    }
    return instantiate(instantiationToken, loggingOn, instanceEnvironment, logMessage, 0);
}

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String instanceName,
    fmi3String instantiationToken, fmi3String resourcePath, fmi3Boolean visible,
    fmi3Boolean loggingOn, fmi3InstanceEnvironment instanceEnvironment,
    fmi3LogMessageCallback logMessage, fmi3ClockUpdateCallback clockUpdate,
    fmi3LockPreemptionCallback lockPreemption, fmi3UnlockPreemptionCallback unlockPreemption)
{
    (void)instanceName, (void)instantiationToken, (void)resourcePath, (void)visible,
        (void)loggingOn;
    (void)clockUpdate, (void)lockPreemption, (void)unlockPreemption;
    if (logMessage)
        logMessage(instanceEnvironment, fmi3Error, "logStatusError",
            "there is no scheduled execution: take model exchange or co-simulation");
    return NULL;
}

void fmi3FreeInstance(fmi3Instance instance)
{
    free(instance);
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean toleranceDefined,
    fmi3Float64 tolerance, fmi3Float64 startTime, fmi3Boolean stopTimeDefined, fmi3Float64 stopTime)
{
    Instance *const a = instance;
    const fmi3Status status = enter(a, unitNew, unitStarting, "fmi3EnterInitializationMode");

    (void)stopTimeDefined, (void)stopTime;
    if (status == fmi3OK) {
        a->unit.x.t = a->unit.x.origin = startTime;
        if (toleranceDefined)
            a->unit.x.tolerance = tolerance;
    }
    return status;
}

/* --- variables ---------------------------------------------------------------------------------- */

fmi3Status fmi3GetFloat64(fmi3Instance instance, const fmi3ValueReference valueReferences[],
    size_t nValueReferences, fmi3Float64 values[], size_t nValues)
{
    if (nValues != nValueReferences)
        return refused(instance, "fmi3GetFloat64: as many values as value references");
    return get(instance, valueReferences, nValues, values);
}

fmi3Status fmi3SetFloat64(fmi3Instance instance, const fmi3ValueReference valueReferences[],
    size_t nValueReferences, const fmi3Float64 values[], size_t nValues)
{
    if (nValues != nValueReferences)
        return refused(instance, "fmi3SetFloat64: as many values as value references");
    return set(instance, valueReferences, nValues, values);
}

fmi3Status fmi3GetBoolean(fmi3Instance instance, const fmi3ValueReference valueReferences[],
    size_t nValueReferences, fmi3Boolean values[], size_t nValues)
{
    Instance *const a = instance;

    for (size_t i = 0; i < nValueReferences; i++) {
        if (valueReferences[i] != unitFollowSignals || i >= nValues)
            return refused(a, "there is no Boolean variable of this value reference");
        values[i] = a->unit.x.signals != 0;
    }
    return fmi3OK;
}

fmi3Status fmi3SetBoolean(fmi3Instance instance, const fmi3ValueReference valueReferences[],
    size_t nValueReferences, const fmi3Boolean values[], size_t nValues)
{
    Instance *const a = instance;

    for (size_t i = 0; i < nValueReferences; i++) {
        if (valueReferences[i] != unitFollowSignals || i >= nValues)
            return refused(a, "there is no Boolean variable of this value reference");
        a->unit.x.signals = values[i];
    }
    return fmi3OK;
}

/* Types that no variable has: calls without value references succeed. */
#define NONE(name, values)                                                                   \
    fmi3Status fmi3##name(fmi3Instance instance, const fmi3ValueReference valueReferences[], \
        size_t nValueReferences, values, size_t nValues)                                     \
    {                                                                                        \
        (void)valueReferences, (void)unused, (void)nValues;                                  \
        return nValueReferences                                                              \
            ? refused(instance, "there are no variables of this type: fmi3" #name)           \
            : fmi3OK;                                                                        \
    }

NONE(GetFloat32, fmi3Float32 unused[])
NONE(GetInt8, fmi3Int8 unused[])
NONE(GetUInt8, fmi3UInt8 unused[])
NONE(GetInt16, fmi3Int16 unused[])
NONE(GetUInt16, fmi3UInt16 unused[])
NONE(GetInt32, fmi3Int32 unused[])
NONE(GetUInt32, fmi3UInt32 unused[])
NONE(GetInt64, fmi3Int64 unused[])
NONE(GetUInt64, fmi3UInt64 unused[])
NONE(GetString, fmi3String unused[])
NONE(SetFloat32, const fmi3Float32 unused[])
NONE(SetInt8, const fmi3Int8 unused[])
NONE(SetUInt8, const fmi3UInt8 unused[])
NONE(SetInt16, const fmi3Int16 unused[])
NONE(SetUInt16, const fmi3UInt16 unused[])
NONE(SetInt32, const fmi3Int32 unused[])
NONE(SetUInt32, const fmi3UInt32 unused[])
NONE(SetInt64, const fmi3Int64 unused[])
NONE(SetUInt64, const fmi3UInt64 unused[])
NONE(SetString, const fmi3String unused[])

fmi3Status fmi3GetBinary(fmi3Instance instance, const fmi3ValueReference valueReferences[],
    size_t nValueReferences, size_t valueSizes[], fmi3Binary values[], size_t nValues)
{
    (void)valueReferences, (void)valueSizes, (void)values, (void)nValues;
    return nValueReferences
        ? refused(instance, "there are no variables of this type: fmi3GetBinary")
        : fmi3OK;
}

fmi3Status fmi3SetBinary(fmi3Instance instance, const fmi3ValueReference valueReferences[],
    size_t nValueReferences, const size_t valueSizes[], const fmi3Binary values[], size_t nValues)
{
    (void)valueReferences, (void)valueSizes, (void)values, (void)nValues;
    return nValueReferences
        ? refused(instance, "there are no variables of this type: fmi3SetBinary")
        : fmi3OK;
}

fmi3Status fmi3GetClock(fmi3Instance instance, const fmi3ValueReference valueReferences[],
    size_t nValueReferences, fmi3Clock values[])
{
    (void)valueReferences, (void)values;
    return nValueReferences ? refused(instance, "there are no clocks: fmi3GetClock") : fmi3OK;
}

fmi3Status fmi3SetClock(fmi3Instance instance, const fmi3ValueReference valueReferences[],
    size_t nValueReferences, const fmi3Clock values[])
{
    (void)valueReferences, (void)values;
    return nValueReferences ? refused(instance, "there are no clocks: fmi3SetClock") : fmi3OK;
}

fmi3Status fmi3GetNumberOfVariableDependencies(
    fmi3Instance instance, fmi3ValueReference valueReference, size_t *nDependencies)
{
    (void)valueReference, (void)nDependencies;
    return refused(instance, "dependencies are those of modelDescription.xml");
}

fmi3Status fmi3GetVariableDependencies(fmi3Instance instance, fmi3ValueReference dependent,
    size_t elementIndicesOfDependent[], fmi3ValueReference independents[],
    size_t elementIndicesOfIndependents[], fmi3DependencyKind dependencyKinds[],
    size_t nDependencies)
{
    (void)dependent, (void)elementIndicesOfDependent, (void)independents,
        (void)elementIndicesOfIndependents;
    (void)dependencyKinds, (void)nDependencies;
    return refused(instance, "dependencies are those of modelDescription.xml");
}

/* --- derivatives -------------------------------------------------------------------------------- */

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance instance, const fmi3ValueReference unknowns[],
    size_t nUnknowns, const fmi3ValueReference knowns[], size_t nKnowns, const fmi3Float64 seed[],
    size_t nSeed, fmi3Float64 sensitivity[], size_t nSensitivity)
{
    Instance *const a = instance;

    if (nSeed != nKnowns || nSensitivity != nUnknowns)
        return refused(a,
            "fmi3GetDirectionalDerivative: a seed for each known, a sensitivity for each unknown");
    return outcome(a, unitSlope(&a->unit, unknowns, nUnknowns, knowns, nKnowns, seed, sensitivity));
}

fmi3Status fmi3GetAdjointDerivative(fmi3Instance instance, const fmi3ValueReference unknowns[],
    size_t nUnknowns, const fmi3ValueReference knowns[], size_t nKnowns, const fmi3Float64 seed[],
    size_t nSeed, fmi3Float64 sensitivity[], size_t nSensitivity)
{
    (void)unknowns, (void)nUnknowns, (void)knowns, (void)nKnowns, (void)seed, (void)nSeed;
    (void)sensitivity, (void)nSensitivity;
    return refused(instance, "there are no adjoint derivatives: take directional ones");
}

/* --- modes -------------------------------------------------------------------------------------- */

fmi3Status fmi3EnterConfigurationMode(fmi3Instance instance)
{
    return refused(instance, "there are no structural parameters");
}

fmi3Status fmi3ExitConfigurationMode(fmi3Instance instance)
{
    return refused(instance, "there are no structural parameters");
}

fmi3Status fmi3EnterStepMode(fmi3Instance instance)
{
    return refused(
        instance, "events are dealt with inside steps: there is no event mode in co-simulation");
}

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance instance, fmi3Boolean *discreteStatesNeedUpdate,
    fmi3Boolean *terminateSimulation, fmi3Boolean *nominalsOfContinuousStatesChanged,
    fmi3Boolean *valuesOfContinuousStatesChanged, fmi3Boolean *nextEventTimeDefined,
    fmi3Float64 *nextEventTime)
{
    Instance *const a = instance;
    int jumped = 0;
    const UnitResult result = unitHappen(&a->unit, &jumped, log_event, a);

    *discreteStatesNeedUpdate = *nominalsOfContinuousStatesChanged = *nextEventTimeDefined = false;
    *nextEventTime = 0;
    *terminateSimulation = a->unit.x.stopped != 0;
    *valuesOfContinuousStatesChanged = jumped != 0;
    return outcome(a, result);
}

fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance instance)
{
    (void)instance;
    return fmi3OK;
}

/* Clocks: there are none. */
#define NO_CLOCK(name, values)                                                                   \
    fmi3Status fmi3##name(fmi3Instance instance, const fmi3ValueReference valueReferences[],     \
        size_t nValueReferences, values)                                                         \
    {                                                                                            \
        (void)valueReferences, (void)unused;                                                     \
        return nValueReferences ? refused(instance, "there are no clocks: fmi3" #name) : fmi3OK; \
    }
#define NO_CLOCK_OF_TWO(name, values, others)                                                    \
    fmi3Status fmi3##name(fmi3Instance instance, const fmi3ValueReference valueReferences[],     \
        size_t nValueReferences, values, others)                                                 \
    {                                                                                            \
        (void)valueReferences, (void)unused, (void)others_unused;                                \
        return nValueReferences ? refused(instance, "there are no clocks: fmi3" #name) : fmi3OK; \
    }

NO_CLOCK_OF_TWO(GetIntervalDecimal, fmi3Float64 unused[], fmi3IntervalQualifier others_unused[])
NO_CLOCK(GetShiftDecimal, fmi3Float64 unused[])
NO_CLOCK_OF_TWO(GetShiftFraction, fmi3UInt64 unused[], fmi3UInt64 others_unused[])
NO_CLOCK(SetIntervalDecimal, const fmi3Float64 unused[])
NO_CLOCK_OF_TWO(SetIntervalFraction, const fmi3UInt64 unused[], const fmi3UInt64 others_unused[])
NO_CLOCK(SetShiftDecimal, const fmi3Float64 unused[])
NO_CLOCK_OF_TWO(SetShiftFraction, const fmi3UInt64 unused[], const fmi3UInt64 others_unused[])

fmi3Status fmi3GetIntervalFraction(fmi3Instance instance,
    const fmi3ValueReference valueReferences[], size_t nValueReferences, fmi3UInt64 counters[],
    fmi3UInt64 resolutions[], fmi3IntervalQualifier qualifiers[])
{
    (void)valueReferences, (void)counters, (void)resolutions, (void)qualifiers;
    return nValueReferences ? refused(instance, "there are no clocks: fmi3GetIntervalFraction")
                            : fmi3OK;
}

fmi3Status fmi3ActivateModelPartition(
    fmi3Instance instance, fmi3ValueReference clockReference, fmi3Float64 activationTime)
{
    (void)clockReference, (void)activationTime;
    return refused(instance, "there is no scheduled execution");
}

/* --- model exchange ----------------------------------------------------------------------------- */

fmi3Status fmi3GetContinuousStateDerivatives(
    fmi3Instance instance, fmi3Float64 values[], size_t nContinuousStates)
{
    return derivatives(instance, values, nContinuousStates);
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance instance, size_t *nEventIndicators)
{
    (void)instance;
    *nEventIndicators = (size_t)unitNE;
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance instance, size_t *nContinuousStates)
{
    (void)instance;
    *nContinuousStates = (size_t)unitNX;
    return fmi3OK;
}

/* --- co-simulation ------------------------------------------------------------------------------ */

fmi3Status fmi3GetOutputDerivatives(fmi3Instance instance,
    const fmi3ValueReference valueReferences[], size_t nValueReferences, const fmi3Int32 orders[],
    fmi3Float64 values[], size_t nValues)
{
    (void)valueReferences, (void)nValueReferences, (void)orders, (void)values, (void)nValues;
    return refused(instance, "there are no derivatives of outputs by time");
}

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 currentCommunicationPoint,
    fmi3Float64 communicationStepSize, fmi3Boolean noSetFMUStatePriorToCurrentPoint,
    fmi3Boolean *eventHandlingNeeded, fmi3Boolean *terminateSimulation, fmi3Boolean *earlyReturn,
    fmi3Float64 *lastSuccessfulTime)
{
    Instance *const a = instance;
    const UnitResult result =
        unitCommunicate(&a->unit, currentCommunicationPoint, communicationStepSize, log_event, a);

    (void)noSetFMUStatePriorToCurrentPoint;
    *eventHandlingNeeded = false;
    *terminateSimulation = a->unit.x.stopped != 0;
    /* an event has stopped the motion within the step; at the end of the step, it is complete */
    *earlyReturn = a->unit.x.stopped &&
        a->unit.x.t < currentCommunicationPoint + communicationStepSize;
    *lastSuccessfulTime = a->unit.x.t;
    return outcome(a, result);
}
