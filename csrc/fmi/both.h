/*
 * Functions that FMI 2.0 and 3.0 have in common: FMI(name) is fmi2name or fmi3name, FMI_STATE(a, b) the
 * name of a function for states. Included after Instance and log_message(). Written by hand.
 */

static FMI(Status) outcome(Instance *a, UnitResult result)
{
    if (result == unitOk)
        return FMI(OK);
    if (result == unitImpossible) {
        log_message(a, FMI(Discard), "logStatusDiscard", a->unit.message);
        return FMI(Discard);
    }
    log_message(a, FMI(Error), "logStatusError", a->unit.message);
    return FMI(Error);
}

static FMI(Status) refused(Instance *a, const char *text)
{
    return outcome(a, unitSay(&a->unit, unitRefused, text));
}

static void log_event(void *instance, const char *text)
{
    const Instance *const a = instance;

    log_message(a, FMI(OK), "logEvents", text);
}

static FMI(Status) enter(Instance *a, UnitMode from, UnitMode to, const char *call)
{
    if (a->unit.x.mode != from) {
        snprintf(
            a->unit.message, sizeof a->unit.message, "%s is not for the mode that the unit is in",
            call);
        return outcome(a, unitRefused);
    }
    a->unit.x.mode = to;
    return FMI(OK);
}

/* --- instances ---------------------------------------------------------------------------------- */

FMI(Status) FMI(SetDebugLogging)(
    FMI_INSTANCE instance, FMI(Boolean) on, size_t count, const FMI(String) categories[])
{
    Instance *const a = instance;

    if (count == 0)
        a->errors = a->events = on;
    for (size_t i = 0; i < count; i++) {
        if (!strcmp(categories[i], "logEvents"))
            a->events = on;
        else if (!strcmp(categories[i], "logStatusError") ||
            !strcmp(categories[i], "logStatusDiscard"))
            a->errors = on;
        else
            return refused(a,
                "there is no such category of messages: logEvents, logStatusDiscard, "
                "logStatusError");
    }
    return FMI(OK);
}

FMI(Status) FMI(ExitInitializationMode)(FMI_INSTANCE instance)
{
    Instance *const a = instance;
    const FMI(Status) status = enter(a, unitStarting,
        a->unit.x.exchange ? unitAtEvent : unitStepping, FMI_TEXT(ExitInitializationMode));

    if (status == FMI(OK)) {
        Unit *const x = &a->unit.x;
        int failure = 0;

        for (int i = 0; i < unitNQ && !failure; i++)
            failure = x->q[i] - x->q[i] == 0 && x->qd[i] - x->qd[i] == 0 ? 0 : 2;
        if (!failure)
            failure = unitAssemble(x->q, x->qd, (unitReal)x->t, &x->p);
        if (failure)
            return outcome(a, unitFailed(&a->unit, failure));
        (void)unitCrossed(x);
    }
    return status;
}

FMI(Status) FMI(Terminate)(FMI_INSTANCE instance)
{
    Instance *const a = instance;

    a->unit.x.mode = unitEnded;
    return FMI(OK);
}

FMI(Status) FMI(Reset)(FMI_INSTANCE instance)
{
    Instance *const a = instance;

    unitReset(&a->unit.x, a->unit.x.exchange);
    return FMI(OK);
}

/* --- variables ---------------------------------------------------------------------------------- */

static FMI(Status) get(Instance *a, const FMI(ValueReference) which[], size_t count, double values[])
{
    UnitValues v = { 0 };
    UnitResult result = unitOk;

    for (size_t i = 0; i < count && result == unitOk; i++)
        result = unitGet(&a->unit, which[i], &v, &values[i]);
    return outcome(a, result);
}

static FMI(Status) set(
    Instance *a, const FMI(ValueReference) which[], size_t count, const double values[])
{
    UnitResult result = unitOk;

    for (size_t i = 0; i < count && result == unitOk; i++)
        result = unitSet(&a->unit, which[i], values[i]);
    return outcome(a, result);
}

/* --- states ------------------------------------------------------------------------------------- */

static FMI(Status) store(Instance *a, const Unit *x, void **state)
{
    if (!*state)
        *state = malloc(sizeof *x);
    if (!*state)
        return refused(a, "there is no memory for a state");
    memcpy(*state, x, sizeof *x);
    return FMI(OK);
}

FMI(Status) FMI_STATE(Get, )(FMI_INSTANCE instance, void **state)
{
    Instance *const a = instance;

    return store(a, &a->unit.x, state);
}

FMI(Status) FMI_STATE(Set, )(FMI_INSTANCE instance, void *state)
{
    Instance *const a = instance;

    if (!state)
        return refused(a, FMI_TEXT(SetFMUState) ": there is no state");
    memcpy(&a->unit.x, state, sizeof a->unit.x);
    return FMI(OK);
}

FMI(Status) FMI_STATE(Free, )(FMI_INSTANCE instance, void **state)
{
    (void)instance;
    if (state) {
        free(*state);
        *state = NULL;
    }
    return FMI(OK);
}

FMI(Status) FMI_STATE(Serialized, Size)(FMI_INSTANCE instance, void *state, size_t *size)
{
    (void)instance, (void)state;
    *size = (size_t)unitBytes;
    return FMI(OK);
}

FMI(Status) FMI_STATE(Serialize, )(
    FMI_INSTANCE instance, void *state, FMI(Byte) bytes[], size_t size)
{
    if (!state || size < (size_t)unitBytes)
        return refused(instance,
            "there is no state to serialize, or not as much room as its serialized size");
    unitPack(state, (unsigned char *)bytes);
    return FMI(OK);
}

FMI(Status) FMI_DESERIALIZE(
    FMI_INSTANCE instance, const FMI(Byte) bytes[], size_t size, void **state)
{
    Instance *const a = instance;
    Unit x;
    const UnitResult result = unitUnpack(&a->unit, (const unsigned char *)bytes, size, &x);

    return result ? outcome(a, result) : store(a, &x, state);
}

/* --- model exchange ----------------------------------------------------------------------------- */

FMI(Status) FMI(EnterEventMode)(FMI_INSTANCE instance)
{
    return enter(instance, unitContinuous, unitAtEvent, FMI_TEXT(EnterEventMode));
}

FMI(Status) FMI(EnterContinuousTimeMode)(FMI_INSTANCE instance)
{
    return enter(instance, unitAtEvent, unitContinuous, FMI_TEXT(EnterContinuousTimeMode));
}

FMI(Status) FMI(CompletedIntegratorStep)(FMI_INSTANCE instance, FMI(Boolean) no_state_prior,
    FMI(Boolean) *enter_event_mode, FMI(Boolean) *terminate)
{
    Instance *const a = instance;

    (void)no_state_prior;
    *enter_event_mode = unitCrossed(&a->unit.x) != 0;
    *terminate = 0;
    return FMI(OK);
}

FMI(Status) FMI(SetTime)(FMI_INSTANCE instance, double time)
{
    Instance *const a = instance;

    a->unit.x.t = time;
    return FMI(OK);
}

FMI(Status) FMI(SetContinuousStates)(FMI_INSTANCE instance, const double x[], size_t count)
{
    Instance *const a = instance;

    if (count != (size_t)unitNX)
        return refused(a,
            FMI_TEXT(SetContinuousStates) ": coordinates and velocities, no more and no less");
    unitPut(&a->unit.x, x);
    return FMI(OK);
}

FMI(Status) FMI(GetContinuousStates)(FMI_INSTANCE instance, double x[], size_t count)
{
    Instance *const a = instance;

    if (count != (size_t)unitNX)
        return refused(a,
            FMI_TEXT(GetContinuousStates) ": coordinates and velocities, no more and no less");
    unitTake(&a->unit.x, x);
    return FMI(OK);
}

static FMI(Status) derivatives(Instance *a, double values[], size_t count)
{
    if (count != (size_t)unitNX)
        return refused(a, "derivatives: of coordinates and velocities, no more and no less");
    return outcome(a, unitDerivatives(&a->unit, values));
}

FMI(Status) FMI(GetEventIndicators)(FMI_INSTANCE instance, double indicators[], size_t count)
{
    Instance *const a = instance;

    if (count != (size_t)unitNE)
        return refused(a, FMI_TEXT(GetEventIndicators) ": one for each event");
    return outcome(a, unitIndicators(&a->unit, indicators));
}

FMI(Status) FMI(GetNominalsOfContinuousStates)(FMI_INSTANCE instance, double nominals[], size_t count)
{
    (void)instance;
    for (size_t i = 0; i < count; i++)
        nominals[i] = 1;
    return FMI(OK);
}
