/* FMI 2.0 around `Model`: what both interfaces share, and co-simulation. */
#include "fmi2_instance.h"

#include <stdlib.h>
#include <string.h>

static void tell(const Instance *instance, fmi2Status status, unsigned category, const char *text)
{
    const fmi2CallbackFunctions *callbacks = instance->callbacks;
    if (callbacks->logger == NULL || (status < fmi2Error && (instance->logged & (1U << category)) == 0)) return;
    callbacks->logger(callbacks->componentEnvironment, instance->name, status, log_categories[category], text);
}

fmi2Status report(const Instance *instance, fmi2Status status, const char *function, const char *message)
{
    char text[MESSAGE_SIZE];
    compose(text, function, message);
    tell(instance, status, status >= fmi2Error ? 0 : 1, text);
    return status;
}

fmi2Status answer(const Instance *instance, const char *function, const char *message)
{
    return message == NULL ? fmi2OK : report(instance, fmi2Error, function, message);
}

void report_events(Instance *instance)
{
    char text[MESSAGE_SIZE];
    while ((instance->logged & LOG_EVENTS) && model_next_event(&instance->core.model, text)) tell(instance, fmi2OK, 2, text);
}

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }

const char *fmi2GetVersion(void) { return fmi2Version; }

fmi2Status fmi2SetDebugLogging(fmi2Component component, fmi2Boolean on, size_t count, const fmi2String categories[])
{
    OPEN("fmi2SetDebugLogging", ~0);
    const unsigned bits = category_bits(count, categories);
    if (bits == 0) return answer(instance, "fmi2SetDebugLogging", "there is no such category");
    instance->logged = on ? instance->logged | bits : instance->logged & ~bits;
    return fmi2OK;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *callbacks, fmi2Boolean visible, fmi2Boolean logging)
{
    (void)resources;
    (void)visible;
    if (callbacks == NULL || name == NULL || guid == NULL) return NULL;
    Instance *instance = calloc(1, sizeof *instance);
    const size_t size = strlen(name) + 1;
    char *copy = malloc(size);
    if (instance == NULL || copy == NULL) {
        free(instance);
        free(copy);
        return NULL;
    }
    instance->name = memcpy(copy, name, size);
    instance->callbacks = callbacks;
    instance->logged = logging ? LOG_ALL : 0;
    if (strcmp(guid, TOKEN) != 0) {
        answer(instance, "fmi2Instantiate", "the GUID is not that of this model");
        fmi2FreeInstance(instance);
        return NULL;
    }
    if (type == fmi2ModelExchange && !HAS_EXCHANGE) {
        answer(instance, "fmi2Instantiate", "the model is for co-simulation only");
        fmi2FreeInstance(instance);
        return NULL;
    }
    core_reset(&instance->core, type == fmi2ModelExchange);
    return instance;
}

void fmi2FreeInstance(fmi2Component component)
{
    Instance *instance = component;
    if (instance == NULL) return;
    free(instance->name);
    free(instance);
}

fmi2Status fmi2SetupExperiment(fmi2Component component, fmi2Boolean tolerance_defined, fmi2Real tolerance,
                               fmi2Real start, fmi2Boolean stop_defined, fmi2Real stop)
{
    (void)tolerance_defined;
    (void)tolerance;
    OPEN("fmi2SetupExperiment", INSTANTIATED);
    return answer(instance, "fmi2SetupExperiment", core_begin(&instance->core, start, stop_defined, stop));
}

fmi2Status fmi2EnterInitializationMode(fmi2Component component)
{
    OPEN("fmi2EnterInitializationMode", INSTANTIATED);
    model_start(&instance->core.model);
    instance->core.phase = INITIALISING;
    return fmi2OK;
}

fmi2Status fmi2ExitInitializationMode(fmi2Component component)
{
    OPEN("fmi2ExitInitializationMode", INITIALISING);
    return answer(instance, "fmi2ExitInitializationMode", core_leave_initialisation(&instance->core));
}

fmi2Status fmi2Terminate(fmi2Component component)
{
    OPEN("fmi2Terminate", RUNNING | FAILED);
    instance->core.phase = TERMINATED;
    return fmi2OK;
}

fmi2Status fmi2Reset(fmi2Component component)
{
    OPEN("fmi2Reset", ~0);
    core_reset(&instance->core, instance->core.model.exchange);
    return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component component, const fmi2ValueReference references[], size_t count, fmi2Real values[])
{
    OPEN("fmi2GetReal", INSTANTIATED | READABLE);
    for (size_t i = 0; i < count; i++) {
        const char *message = core_get(&instance->core, references[i], &values[i]);
        if (message != NULL) return answer(instance, "fmi2GetReal", message);
    }
    return fmi2OK;
}

fmi2Status fmi2SetReal(fmi2Component component, const fmi2ValueReference references[], size_t count,
                       const fmi2Real values[])
{
    OPEN("fmi2SetReal", INSTANTIATED | INITIALISING | RUNNING);
    for (size_t i = 0; i < count; i++) {
        const char *message = core_set(&instance->core, references[i], values[i]);
        if (message != NULL) return answer(instance, "fmi2SetReal", message);
    }
    if (instance->core.phase & (INSTANTIATED | INITIALISING)) model_start(&instance->core.model);
    return fmi2OK;
}

/* The model has real variables only. */
#define NO_VARIABLES(name, type)                                                                                  \
    fmi2Status name(fmi2Component component, const fmi2ValueReference references[], size_t count, type values[]) \
    {                                                                                                             \
        (void)references;                                                                                         \
        (void)values;                                                                                             \
        OPEN(#name, ~0);                                                                                          \
        return answer(instance, #name, count == 0 ? NULL : "the model has real variables only");                   \
    }

NO_VARIABLES(fmi2GetInteger, fmi2Integer)
NO_VARIABLES(fmi2GetBoolean, fmi2Boolean)
NO_VARIABLES(fmi2GetString, fmi2String)
NO_VARIABLES(fmi2SetInteger, const fmi2Integer)
NO_VARIABLES(fmi2SetBoolean, const fmi2Boolean)
NO_VARIABLES(fmi2SetString, const fmi2String)

fmi2Status fmi2GetFMUstate(fmi2Component component, fmi2FMUstate *state)
{
    OPEN("fmi2GetFMUstate", ~0);
    Snapshot *snapshot = snapshot_take(&instance->core);
    if (snapshot == NULL) return answer(instance, "fmi2GetFMUstate", "out of memory");
    free(*state);
    *state = snapshot;
    return fmi2OK;
}

fmi2Status fmi2SetFMUstate(fmi2Component component, fmi2FMUstate state)
{
    OPEN("fmi2SetFMUstate", ~0);
    return answer(instance, "fmi2SetFMUstate", core_restore(&instance->core, state));
}

fmi2Status fmi2FreeFMUstate(fmi2Component component, fmi2FMUstate *state)
{
    OPEN("fmi2FreeFMUstate", ~0);
    free(*state);
    *state = NULL;
    return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component component, fmi2FMUstate state, size_t *size)
{
    (void)state;
    OPEN("fmi2SerializedFMUstateSize", ~0);
    *size = sizeof(Snapshot);
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component component, fmi2FMUstate state, fmi2Byte bytes[], size_t size)
{
    OPEN("fmi2SerializeFMUstate", ~0);
    if (state == NULL || size < sizeof(Snapshot)) return answer(instance, "fmi2SerializeFMUstate", "no state or no room");
    memcpy(bytes, state, sizeof(Snapshot));
    return fmi2OK;
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component component, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state)
{
    OPEN("fmi2DeSerializeFMUstate", ~0);
    Snapshot *snapshot = snapshot_read(bytes, size);
    if (snapshot == NULL) return answer(instance, "fmi2DeSerializeFMUstate", "these bytes are no state of this model");
    free(*state);
    *state = snapshot;
    return fmi2OK;
}

fmi2Status fmi2GetDirectionalDerivative(fmi2Component component, const fmi2ValueReference unknowns[], size_t n_unknowns,
                                        const fmi2ValueReference knowns[], size_t n_knowns, const fmi2Real seed[],
                                        fmi2Real sensitivity[])
{
    OPEN("fmi2GetDirectionalDerivative", DIFFERENTIABLE);
    double direction[N_VALUES] = {0.0};
    for (size_t i = 0; i < n_knowns; i++) {
        if (knowns[i] >= N_SETTABLE) return answer(instance, "fmi2GetDirectionalDerivative", "this is no known");
        direction[knowns[i]] = seed[i];
    }
    const ModelStatus status = model_derive(&instance->core.model, direction, instance->core.phase == INITIALISING);
    if (status != MODEL_OK) return answer(instance, "fmi2GetDirectionalDerivative", model_explain(status));
    for (size_t i = 0; i < n_unknowns; i++) {
        if (unknowns[i] >= N_VALUES) return answer(instance, "fmi2GetDirectionalDerivative", "this is no unknown");
        sensitivity[i] = direction[unknowns[i]];
    }
    return fmi2OK;
}

/* Co-simulation */

fmi2Status fmi2SetRealInputDerivatives(fmi2Component component, const fmi2ValueReference references[], size_t count,
                                       const fmi2Integer orders[], const fmi2Real values[])
{
    (void)references;
    (void)orders;
    (void)values;
    OPEN("fmi2SetRealInputDerivatives", ~0);
    return answer(instance, "fmi2SetRealInputDerivatives", count == 0 ? NULL : "inputs are held, not interpolated");
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component component, const fmi2ValueReference references[], size_t count,
                                        const fmi2Integer orders[], fmi2Real values[])
{
    (void)references;
    (void)orders;
    (void)values;
    OPEN("fmi2GetRealOutputDerivatives", ~0);
    return answer(instance, "fmi2GetRealOutputDerivatives", count == 0 ? NULL : "not provided");
}

fmi2Status fmi2DoStep(fmi2Component component, fmi2Real time, fmi2Real step, fmi2Boolean no_set_state)
{
    (void)no_set_state;
    OPEN("fmi2DoStep", STEPPING);
    const char *message = core_step(&instance->core, time, step);
    report_events(instance);
    return answer(instance, "fmi2DoStep", message);
}

fmi2Status fmi2CancelStep(fmi2Component component)
{
    OPEN("fmi2CancelStep", ~0);
    return answer(instance, "fmi2CancelStep", "no step is ever pending");
}

fmi2Status fmi2GetStatus(fmi2Component component, const fmi2StatusKind kind, fmi2Status *value)
{
    (void)kind;
    (void)value;
    OPEN("fmi2GetStatus", ~0);
    return report(instance, fmi2Discard, "fmi2GetStatus", "no step is ever pending");
}

fmi2Status fmi2GetRealStatus(fmi2Component component, const fmi2StatusKind kind, fmi2Real *value)
{
    OPEN("fmi2GetRealStatus", ~0);
    if (kind != fmi2LastSuccessfulTime) return report(instance, fmi2Discard, "fmi2GetRealStatus", "not provided");
    *value = instance->core.model.time;
    return fmi2OK;
}

fmi2Status fmi2GetIntegerStatus(fmi2Component component, const fmi2StatusKind kind, fmi2Integer *value)
{
    (void)kind;
    (void)value;
    OPEN("fmi2GetIntegerStatus", ~0);
    return report(instance, fmi2Discard, "fmi2GetIntegerStatus", "not provided");
}

fmi2Status fmi2GetBooleanStatus(fmi2Component component, const fmi2StatusKind kind, fmi2Boolean *value)
{
    OPEN("fmi2GetBooleanStatus", ~0);
    if (kind != fmi2Terminated) return report(instance, fmi2Discard, "fmi2GetBooleanStatus", "not provided");
    *value = instance->core.phase == TERMINATED ? fmi2True : fmi2False;
    return fmi2OK;
}

fmi2Status fmi2GetStringStatus(fmi2Component component, const fmi2StatusKind kind, fmi2String *value)
{
    (void)kind;
    (void)value;
    OPEN("fmi2GetStringStatus", ~0);
    return report(instance, fmi2Discard, "fmi2GetStringStatus", "not provided");
}
