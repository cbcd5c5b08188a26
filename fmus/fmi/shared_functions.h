/* The functions that FMI 2 and FMI 3 share. They differ in names and types: the source file of each version defines these,
   Instance, and `tell`, which passes a message to the importer, and then includes this. */
#ifndef SHARED_FUNCTIONS_H
#define SHARED_FUNCTIONS_H

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* Logs "function: message" and returns the status. Importers without printf formatting get whole texts that way. */
static Status report(const Instance *instance, Status status, const char *function, const char *message)
{
    char text[MESSAGE_SIZE];
    const int error = status == FMI(Error);
    (void)snprintf(text, MESSAGE_SIZE, "%s: %s", function, message);
    if (error || (instance->logged & LOG_WARNINGS)) tell(instance, status, log_categories[error ? 0 : 1], text);
    return status;
}

/* How a function begins, and how it ends with a message or NULL. */
#define OPEN(phases)                     \
    Instance *const self = instance;     \
    if (self == NULL) return FMI(Error); \
    if ((self->core.phase & (phases)) == 0) return ANSWER("not allowed in this phase")
#define ANSWER(message) answer(self, __func__, message)

static Status answer(const Instance *instance, const char *function, const char *message)
{
    return message == NULL ? FMI(OK) : report(instance, FMI(Error), function, message);
}

static void report_events(Instance *instance)
{
    char text[MESSAGE_SIZE];
    while ((instance->logged & LOG_EVENTS) && model_next_event(&instance->core.model, text)) {
        tell(instance, FMI(OK), log_categories[2], text);
    }
}

const char *FMI(GetVersion)(void) { return FMI(Version); }

void FMI(FreeInstance)(Handle instance) { free(instance); }

/* The instance, ready for its start; NULL, and it is freed, if it is not one of this model. */
static Instance *open_instance(Instance *instance, const char *function, const char *token, int exchange, int logging)
{
    const char *message = NULL;
    if (token == NULL || strcmp(token, TOKEN) != 0) message = "the " TOKEN_NAME " is not that of this model";
    else if (exchange && !HAS_EXCHANGE) message = "the model is for co-simulation only";
    if (answer(instance, function, message) != FMI(OK)) {
        free(instance);
        return NULL;
    }
    instance->logged = logging ? LOG_ALL : 0;
    core_reset(&instance->core, exchange);
    return instance;
}

Status FMI(SetDebugLogging)(Handle instance, Boolean on, size_t count, const String categories[])
{
    OPEN(~0);
    const unsigned bits = category_bits(count, categories);
    if (bits == 0) return ANSWER("there is no such category");
    self->logged = on ? bits : 0;
    return FMI(OK);
}

Status FMI(ExitInitializationMode)(Handle instance)
{
    OPEN(INITIALISING);
    return ANSWER(core_leave_initialisation(&self->core));
}

Status FMI(Terminate)(Handle instance)
{
    OPEN(RUNNING | FAILED);
    self->core.phase = TERMINATED;
    return FMI(OK);
}

Status FMI(Reset)(Handle instance)
{
    OPEN(~0);
    core_reset(&self->core, self->core.model.exchange);
    return FMI(OK);
}

/* Saved states */

Status FMI_STATE(Get, )(Handle instance, State *state)
{
    OPEN(~0);
    Snapshot *snapshot = snapshot_take(&self->core);
    if (snapshot == NULL) return ANSWER("out of memory");
    free(*state);
    *state = snapshot;
    return FMI(OK);
}

Status FMI_STATE(Set, )(Handle instance, State state)
{
    OPEN(~0);
    return ANSWER(core_restore(&self->core, state));
}

Status FMI_STATE(Free, )(Handle instance, State *state)
{
    OPEN(~0);
    free(*state);
    *state = NULL;
    return FMI(OK);
}

Status FMI_STATE(Serialized, Size)(Handle instance, State state, size_t *size)
{
    OPEN(~0);
    *size = sizeof(Snapshot);
    return FMI(OK);
}

Status FMI_STATE(Serialize, )(Handle instance, State state, Byte bytes[], size_t size)
{
    OPEN(~0);
    if (state == NULL || size < sizeof(Snapshot)) return ANSWER("no state or no room");
    memcpy(bytes, state, sizeof(Snapshot));
    return FMI(OK);
}

Status DESERIALIZE_STATE(Handle instance, const Byte bytes[], size_t size, State *state)
{
    OPEN(~0);
    Snapshot *snapshot = snapshot_read(bytes, size);
    if (snapshot == NULL) return ANSWER("these bytes are no state of this model");
    free(*state);
    *state = snapshot;
    return FMI(OK);
}

/* Model exchange */

Status FMI(EnterEventMode)(Handle instance)
{
    OPEN(EXCHANGING);
    const char *message = core_check_stop_time(&self->core);
    if (message == NULL) self->core.phase = IN_EVENT;
    return ANSWER(message);
}

Status FMI(EnterContinuousTimeMode)(Handle instance)
{
    OPEN(EXCHANGING);
    self->core.phase = CONTINUOUS;
    return FMI(OK);
}

Status FMI(CompletedIntegratorStep)(Handle instance, Boolean no_set_state, Boolean *enter_event, Boolean *terminate)
{
    OPEN(CONTINUOUS);
    *enter_event = *terminate = 0;
    model_accept(&self->core.model);
    return ANSWER(core_check_stop_time(&self->core));
}

Status FMI(SetTime)(Handle instance, double time)
{
    OPEN(EXCHANGING);
    self->core.model.time = time;
    return FMI(OK);
}

static const char *check_count(size_t count, size_t wanted) { return count == wanted ? NULL : "wrong number of values"; }

Status FMI(SetContinuousStates)(Handle instance, const double states[], size_t count)
{
    OPEN(EXCHANGING);
    const char *message = check_count(count, N_STATES);
    if (message == NULL) model_set_states(&self->core.model, states);
    return ANSWER(message);
}

static const char *copy_values(Instance *self, size_t offset, size_t wanted, double values[], size_t count)
{
    const char *message = check_count(count, wanted);
    for (size_t i = 0; message == NULL && i < count; i++) model_get(&self->core.model, offset + i, &values[i]);
    return message;
}

Status FMI(GetContinuousStates)(Handle instance, double states[], size_t count)
{
    OPEN(READABLE);
    return ANSWER(copy_values(self, OFFSET_STATES, N_STATES, states, count));
}

Status GET_DERIVATIVES(Handle instance, double derivatives[], size_t count)
{
    OPEN(DERIVATIVE_PHASES);
    return ANSWER(copy_values(self, OFFSET_DERIVATIVES, N_STATES, derivatives, count));
}

Status FMI(GetEventIndicators)(Handle instance, double indicators[], size_t count)
{
    OPEN(READABLE);
    return ANSWER(copy_values(self, OFFSET_INDICATORS, N_INDICATORS, indicators, count));
}

Status FMI(GetNominalsOfContinuousStates)(Handle instance, double nominals[], size_t count)
{
    OPEN(~0);
    const char *message = check_count(count, N_STATES);
    for (size_t i = 0; message == NULL && i < count; i++) nominals[i] = 1.0;
    return ANSWER(message);
}

#endif
