/* FMI 3.0 around `Model`: both interfaces, but for the functions that FMI 2 shares; variables are arrays of doubles. */
#include "fmi3_instance.h"

#include <stdlib.h>
#include <string.h>

static const struct {
    unsigned offset;
    unsigned size;
} groups[N_GROUPS] = GROUPS;

fmi3Status answer(const Instance *instance, const char *function, const char *message)
{
    if (message == NULL) return fmi3OK;
    char text[MESSAGE_SIZE];
    compose(text, function, message);
    if (instance->log != NULL) instance->log(instance->environment, fmi3Error, log_categories[0], text);
    return fmi3Error;
}

void report_events(Instance *instance)
{
    char text[MESSAGE_SIZE];
    if (instance->log == NULL) return;
    while ((instance->logged & LOG_EVENTS) && model_next_event(&instance->core.model, text)) {
        instance->log(instance->environment, fmi3OK, log_categories[2], text);
    }
}

#define NO_SUCH_VARIABLE "there is no variable with this value reference"

size_t size_of(fmi3ValueReference reference)
{
    for (size_t i = 0; i < N_GROUPS; i++) {
        if (groups[i].offset == reference) return groups[i].size;
    }
    return 0;
}

const char *fmi3GetVersion(void) { return fmi3Version; }

static Instance *instantiate(const char *function, fmi3String token, int exchange, fmi3Boolean logging,
                             fmi3InstanceEnvironment environment, fmi3LogMessageCallback log)
{
    Instance *instance = calloc(1, sizeof *instance);
    if (instance == NULL) return NULL;
    instance->logged = logging ? LOG_ALL : 0;
    instance->log = log;
    instance->environment = environment;
    if (token == NULL || strcmp(token, TOKEN) != 0) {
        answer(instance, function, "the token is not that of this model");
        free(instance);
        return NULL;
    }
    if (exchange && !HAS_EXCHANGE) {
        answer(instance, function, "the model is for co-simulation only");
        free(instance);
        return NULL;
    }
    core_reset(&instance->core, exchange);
    return instance;
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                         fmi3Boolean logging, fmi3Boolean event_mode, fmi3Boolean early_return,
                                         const fmi3ValueReference intermediate[], size_t n_intermediate,
                                         fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                         fmi3IntermediateUpdateCallback update)
{
    return instantiate("fmi3InstantiateCoSimulation", token, 0, logging, environment, log);
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                          fmi3Boolean logging, fmi3InstanceEnvironment environment,
                                          fmi3LogMessageCallback log)
{
    return instantiate("fmi3InstantiateModelExchange", token, 1, logging, environment, log);
}

void fmi3FreeInstance(fmi3Instance instance) { free(instance); }

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean tolerance_defined, fmi3Float64 tolerance,
                                       fmi3Float64 start, fmi3Boolean stop_defined, fmi3Float64 stop)
{
    OPEN(INSTANTIATED);
    const char *message = core_begin(&self->core, start, stop_defined, stop);
    if (message == NULL) {
        model_start(&self->core.model);
        self->core.phase = INITIALISING;
    }
    return ANSWER(message);
}

fmi3Status fmi3GetFloat64(fmi3Instance instance, const fmi3ValueReference references[], size_t count,
                          fmi3Float64 values[], size_t n_values)
{
    OPEN(INSTANTIATED | READABLE);
    size_t k = 0;
    for (size_t i = 0; i < count; i++) {
        if (references[i] == N_VALUES) { /* the independent variable */
            if (k == n_values) return ANSWER("too few values for these variables");
            values[k++] = self->core.model.time;
            continue;
        }
        const size_t size = size_of(references[i]);
        if (size == 0) return ANSWER(NO_SUCH_VARIABLE);
        if (k + size > n_values) return ANSWER("too few values for these variables");
        for (size_t j = 0; j < size; j++) {
            const char *message = core_get(&self->core, references[i] + j, &values[k++]);
            if (message != NULL) return ANSWER(message);
        }
    }
    return ANSWER(k == n_values ? NULL : "too many values for these variables");
}

fmi3Status fmi3SetFloat64(fmi3Instance instance, const fmi3ValueReference references[], size_t count,
                          const fmi3Float64 values[], size_t n_values)
{
    OPEN(INSTANTIATED | INITIALISING | RUNNING);
    size_t k = 0;
    for (size_t i = 0; i < count; i++) {
        const size_t size = size_of(references[i]);
        if (size == 0) return ANSWER(NO_SUCH_VARIABLE);
        if (k + size > n_values) return ANSWER("too few values for these variables");
        for (size_t j = 0; j < size; j++) {
            const char *message = core_set(&self->core, references[i] + j, values[k++]);
            if (message != NULL) return ANSWER(message);
        }
    }
    if (self->core.phase & (INSTANTIATED | INITIALISING)) model_start(&self->core.model);
    return ANSWER(k == n_values ? NULL : "too many values for these variables");
}

fmi3Status fmi3EnterStepMode(fmi3Instance instance)
{
    OPEN(STEPPING);
    return fmi3OK;
}

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 time, fmi3Float64 step, fmi3Boolean no_set_state,
                      fmi3Boolean *event_needed, fmi3Boolean *terminate, fmi3Boolean *early_return,
                      fmi3Float64 *last_time)
{
    OPEN(STEPPING);
    *event_needed = *terminate = *early_return = false;
    const char *message = core_step(&self->core, time, step);
    *last_time = self->core.model.time;
    report_events(self);
    return ANSWER(message);
}

/* Model exchange */

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance instance, fmi3Boolean *again, fmi3Boolean *terminate,
                                    fmi3Boolean *nominals_changed, fmi3Boolean *states_changed,
                                    fmi3Boolean *next_event_defined, fmi3Float64 *next_event)
{
    OPEN(IN_EVENT);
    int changed;
    const char *message = core_update_discrete_states(&self->core, &changed);
    *again = *terminate = *nominals_changed = *next_event_defined = false;
    *states_changed = changed != 0;
    *next_event = 0.0;
    report_events(self);
    return ANSWER(message);
}

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance instance, size_t *count)
{
    OPEN(~0);
    *count = N_STATES;
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance instance, size_t *count)
{
    OPEN(~0);
    *count = N_INDICATORS;
    return fmi3OK;
}

#include "shared_functions.h"
