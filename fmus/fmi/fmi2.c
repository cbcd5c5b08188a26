/* FMI 2.0 around `Model`: both interfaces, but for the functions that FMI 3 shares. */
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

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *callbacks, fmi2Boolean visible, fmi2Boolean logging)
{
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

void fmi2FreeInstance(fmi2Component instance)
{
    Instance *self = instance;
    if (self == NULL) return;
    free(self->name);
    free(self);
}

fmi2Status fmi2SetupExperiment(fmi2Component instance, fmi2Boolean tolerance_defined, fmi2Real tolerance,
                               fmi2Real start, fmi2Boolean stop_defined, fmi2Real stop)
{
    OPEN(INSTANTIATED);
    return ANSWER(core_begin(&self->core, start, stop_defined, stop));
}

fmi2Status fmi2EnterInitializationMode(fmi2Component instance)
{
    OPEN(INSTANTIATED);
    model_start(&self->core.model);
    self->core.phase = INITIALISING;
    return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component instance, const fmi2ValueReference references[], size_t count, fmi2Real values[])
{
    OPEN(INSTANTIATED | READABLE);
    for (size_t i = 0; i < count; i++) {
        const char *message = core_get(&self->core, references[i], &values[i]);
        if (message != NULL) return ANSWER(message);
    }
    return fmi2OK;
}

fmi2Status fmi2SetReal(fmi2Component instance, const fmi2ValueReference references[], size_t count,
                       const fmi2Real values[])
{
    OPEN(INSTANTIATED | INITIALISING | RUNNING);
    for (size_t i = 0; i < count; i++) {
        const char *message = core_set(&self->core, references[i], values[i]);
        if (message != NULL) return ANSWER(message);
    }
    if (self->core.phase & (INSTANTIATED | INITIALISING)) model_start(&self->core.model);
    return fmi2OK;
}

/* The model has real variables only. */
#define NO_VARIABLES(name, type)                                                                                 \
    fmi2Status name(fmi2Component instance, const fmi2ValueReference references[], size_t count, type values[]) \
    {                                                                                                            \
        OPEN(~0);                                                                                                \
        return ANSWER(count == 0 ? NULL : "the model has real variables only");                                  \
    }

NO_VARIABLES(fmi2GetInteger, fmi2Integer)
NO_VARIABLES(fmi2GetBoolean, fmi2Boolean)
NO_VARIABLES(fmi2GetString, fmi2String)
NO_VARIABLES(fmi2SetInteger, const fmi2Integer)
NO_VARIABLES(fmi2SetBoolean, const fmi2Boolean)
NO_VARIABLES(fmi2SetString, const fmi2String)

fmi2Status fmi2GetDirectionalDerivative(fmi2Component instance, const fmi2ValueReference unknowns[], size_t n_unknowns,
                                        const fmi2ValueReference knowns[], size_t n_knowns, const fmi2Real seed[],
                                        fmi2Real sensitivity[])
{
    OPEN(DIFFERENTIABLE);
    double direction[N_VALUES] = {0.0};
    for (size_t i = 0; i < n_knowns; i++) {
        if (knowns[i] >= N_SETTABLE) return ANSWER("this is no known");
        direction[knowns[i]] = seed[i];
    }
    const ModelStatus status = model_derive(&self->core.model, direction, self->core.phase == INITIALISING);
    if (status != MODEL_OK) return ANSWER(model_explain(status));
    for (size_t i = 0; i < n_unknowns; i++) {
        if (unknowns[i] >= N_VALUES) return ANSWER("this is no unknown");
        sensitivity[i] = direction[unknowns[i]];
    }
    return fmi2OK;
}

/* Co-simulation */

fmi2Status fmi2SetRealInputDerivatives(fmi2Component instance, const fmi2ValueReference references[], size_t count,
                                       const fmi2Integer orders[], const fmi2Real values[])
{
    OPEN(~0);
    return ANSWER(count == 0 ? NULL : "inputs are held, not interpolated");
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component instance, const fmi2ValueReference references[], size_t count,
                                        const fmi2Integer orders[], fmi2Real values[])
{
    OPEN(~0);
    return ANSWER(count == 0 ? NULL : "not provided");
}

fmi2Status fmi2DoStep(fmi2Component instance, fmi2Real time, fmi2Real step, fmi2Boolean no_set_state)
{
    OPEN(STEPPING);
    const char *message = core_step(&self->core, time, step);
    report_events(self);
    return ANSWER(message);
}

fmi2Status fmi2CancelStep(fmi2Component instance)
{
    OPEN(~0);
    return ANSWER("no step is ever pending");
}

#define NO_STATUS(name, type, message)                                                       \
    fmi2Status name(fmi2Component instance, const fmi2StatusKind kind, type *value)          \
    {                                                                                        \
        OPEN(~0);                                                                            \
        return report(self, fmi2Discard, __func__, message);                                 \
    }

NO_STATUS(fmi2GetStatus, fmi2Status, "no step is ever pending")
NO_STATUS(fmi2GetIntegerStatus, fmi2Integer, "not provided")
NO_STATUS(fmi2GetStringStatus, fmi2String, "not provided")

fmi2Status fmi2GetRealStatus(fmi2Component instance, const fmi2StatusKind kind, fmi2Real *value)
{
    OPEN(~0);
    if (kind != fmi2LastSuccessfulTime) return report(self, fmi2Discard, __func__, "not provided");
    *value = self->core.model.time;
    return fmi2OK;
}

fmi2Status fmi2GetBooleanStatus(fmi2Component instance, const fmi2StatusKind kind, fmi2Boolean *value)
{
    OPEN(~0);
    if (kind != fmi2Terminated) return report(self, fmi2Discard, __func__, "not provided");
    *value = self->core.phase == TERMINATED ? fmi2True : fmi2False;
    return fmi2OK;
}

/* Model exchange */

fmi2Status fmi2NewDiscreteStates(fmi2Component instance, fmi2EventInfo *info)
{
    OPEN(IN_EVENT);
    int states_changed;
    const char *message = core_update_discrete_states(&self->core, &states_changed);
    memset(info, 0, sizeof *info);
    info->valuesOfContinuousStatesChanged = states_changed;
    report_events(self);
    return ANSWER(message);
}

#include "shared_functions.h"
