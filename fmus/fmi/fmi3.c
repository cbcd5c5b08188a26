/* FMI 3.0 for co-simulation around `Model`; every variable is an array of doubles. */
#include "fmi3Functions.h"
#include "instance.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* How far the importer's time may be from the model's own, relative to its size. */
#define TIME_TOLERANCE 1e-6

typedef struct {
    Model model;
    Phase phase;
    bool logging;
    fmi3LogMessageCallback log;
    fmi3InstanceEnvironment environment;
} Instance;

static const struct {
    unsigned offset;
    unsigned size;
} groups[N_GROUPS] = GROUPS;

static fmi3Status fail(const Instance *instance, const char *function, const char *message)
{
    char text[MESSAGE_SIZE];
    compose(text, function, message);
    if (instance->log != NULL) instance->log(instance->environment, fmi3Error, "logStatusError", text);
    return fmi3Error;
}

#define OPEN(function, phases)                                                                    \
    Instance *const self = instance;                                                              \
    if (self == NULL) return fmi3Error;                                                           \
    if ((self->phase & (phases)) == 0) return fail(self, function, "not allowed in this phase")

/* Number of values behind a reference, 0 if there is no such variable. */
static size_t size_of(fmi3ValueReference reference)
{
    for (size_t i = 0; i < N_GROUPS; i++) {
        if (groups[i].offset == reference) return groups[i].size;
    }
    return 0;
}

const char *fmi3GetVersion(void) { return fmi3Version; }

fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean on, size_t count, const fmi3String categories[])
{
    (void)count;
    (void)categories;
    OPEN("fmi3SetDebugLogging", ~0);
    self->logging = on;
    return fmi3OK;
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                         fmi3Boolean logging, fmi3Boolean event_mode, fmi3Boolean early_return,
                                         const fmi3ValueReference intermediate[], size_t n_intermediate,
                                         fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                         fmi3IntermediateUpdateCallback update)
{
    (void)name;
    (void)resources;
    (void)visible;
    (void)event_mode;
    (void)early_return;
    (void)intermediate;
    (void)n_intermediate;
    (void)update;
    Instance *instance = calloc(1, sizeof *instance);
    if (instance == NULL) return NULL;
    instance->logging = logging;
    instance->log = log;
    instance->environment = environment;
    instance->phase = INSTANTIATED;
    if (token == NULL || strcmp(token, TOKEN) != 0) {
        fail(instance, "fmi3InstantiateCoSimulation", "the token is not that of this model");
        free(instance);
        return NULL;
    }
    model_reset(&instance->model);
    return instance;
}

void fmi3FreeInstance(fmi3Instance instance) { free(instance); }

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean tolerance_defined, fmi3Float64 tolerance,
                                       fmi3Float64 start, fmi3Boolean stop_defined, fmi3Float64 stop)
{
    (void)tolerance_defined;
    (void)tolerance;
    (void)stop_defined;
    (void)stop;
    OPEN("fmi3EnterInitializationMode", INSTANTIATED);
    if (!isfinite(start)) return fail(self, "fmi3EnterInitializationMode", "the start time is not finite");
    self->model.time = start;
    model_start(&self->model);
    self->phase = INITIALISING;
    return fmi3OK;
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance instance)
{
    OPEN("fmi3ExitInitializationMode", INITIALISING);
    if (model_has_empty_range(&self->model)) {
        return fail(self, "fmi3ExitInitializationMode", "joint_lower is not below joint_upper");
    }
    self->phase = STEPPING;
    return fmi3OK;
}

fmi3Status fmi3Terminate(fmi3Instance instance)
{
    OPEN("fmi3Terminate", RUNNING | FAILED);
    self->phase = TERMINATED;
    return fmi3OK;
}

fmi3Status fmi3Reset(fmi3Instance instance)
{
    OPEN("fmi3Reset", ~0);
    model_reset(&self->model);
    self->phase = INSTANTIATED;
    return fmi3OK;
}

fmi3Status fmi3GetFloat64(fmi3Instance instance, const fmi3ValueReference references[], size_t count,
                          fmi3Float64 values[], size_t n_values)
{
    OPEN("fmi3GetFloat64", INSTANTIATED | READABLE);
    size_t k = 0;
    for (size_t i = 0; i < count; i++) {
        if (references[i] == N_VALUES) { /* the independent variable */
            if (k == n_values) return fail(self, "fmi3GetFloat64", "too few values for these variables");
            values[k++] = self->model.time;
            continue;
        }
        const size_t size = size_of(references[i]);
        if (size == 0) return fail(self, "fmi3GetFloat64", explain(MODEL_NO_SUCH_VARIABLE));
        if (k + size > n_values) return fail(self, "fmi3GetFloat64", "too few values for these variables");
        for (size_t j = 0; j < size; j++) model_get(&self->model, references[i] + j, &values[k++]);
    }
    return k == n_values ? fmi3OK : fail(self, "fmi3GetFloat64", "too many values for these variables");
}

fmi3Status fmi3SetFloat64(fmi3Instance instance, const fmi3ValueReference references[], size_t count,
                          const fmi3Float64 values[], size_t n_values)
{
    OPEN("fmi3SetFloat64", INSTANTIATED | INITIALISING | RUNNING);
    size_t k = 0;
    for (size_t i = 0; i < count; i++) {
        const size_t size = size_of(references[i]);
        if (size == 0) return fail(self, "fmi3SetFloat64", explain(MODEL_NO_SUCH_VARIABLE));
        if (references[i] >= OFFSET_JOINT_POSITION) return fail(self, "fmi3SetFloat64", explain(MODEL_NOT_SETTABLE));
        if (k + size > n_values) return fail(self, "fmi3SetFloat64", "too few values for these variables");
        for (size_t j = 0; j < size; j++) {
            const ModelStatus status = model_set(&self->model, references[i] + j, values[k++]);
            if (status != MODEL_OK) return fail(self, "fmi3SetFloat64", explain(status));
        }
    }
    if (self->phase & (INSTANTIATED | INITIALISING)) model_start(&self->model);
    return k == n_values ? fmi3OK : fail(self, "fmi3SetFloat64", "too many values for these variables");
}

fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *state)
{
    OPEN("fmi3GetFMUState", ~0);
    Snapshot *snapshot = snapshot_take(&self->model, self->phase);
    if (snapshot == NULL) return fail(self, "fmi3GetFMUState", "out of memory");
    free(*state);
    *state = snapshot;
    return fmi3OK;
}

fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState state)
{
    OPEN("fmi3SetFMUState", ~0);
    if (state == NULL) return fail(self, "fmi3SetFMUState", "there is no state");
    const Snapshot *snapshot = state;
    memcpy(&self->model, &snapshot->model, sizeof self->model);
    self->phase = snapshot->phase;
    return fmi3OK;
}

fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *state)
{
    OPEN("fmi3FreeFMUState", ~0);
    free(*state);
    *state = NULL;
    return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance instance, fmi3FMUState state, size_t *size)
{
    (void)state;
    OPEN("fmi3SerializedFMUStateSize", ~0);
    *size = sizeof(Snapshot);
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance instance, fmi3FMUState state, fmi3Byte bytes[], size_t size)
{
    OPEN("fmi3SerializeFMUState", ~0);
    if (state == NULL || size < sizeof(Snapshot)) return fail(self, "fmi3SerializeFMUState", "no state or no room");
    memcpy(bytes, state, sizeof(Snapshot));
    return fmi3OK;
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance instance, const fmi3Byte bytes[], size_t size, fmi3FMUState *state)
{
    OPEN("fmi3DeserializeFMUState", ~0);
    Snapshot *snapshot = snapshot_read(bytes, size);
    if (snapshot == NULL) return fail(self, "fmi3DeserializeFMUState", "these bytes are no state of this model");
    free(*state);
    *state = snapshot;
    return fmi3OK;
}

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance instance, const fmi3ValueReference unknowns[], size_t n_unknowns,
                                        const fmi3ValueReference knowns[], size_t n_knowns, const fmi3Float64 seed[],
                                        size_t n_seed, fmi3Float64 sensitivity[], size_t n_sensitivity)
{
    OPEN("fmi3GetDirectionalDerivative", INITIALISING | RUNNING);
    double direction[N_VALUES] = {0.0};
    size_t k = 0;
    for (size_t i = 0; i < n_knowns; i++) {
        const size_t size = size_of(knowns[i]);
        if (size == 0 || knowns[i] >= N_SETTABLE) return fail(self, "fmi3GetDirectionalDerivative", "this is no known");
        if (k + size > n_seed) return fail(self, "fmi3GetDirectionalDerivative", "too few values in the seed");
        memcpy(direction + knowns[i], seed + k, size * sizeof(double));
        k += size;
    }
    model_derive(&self->model, direction, self->phase == INITIALISING);
    size_t j = 0;
    for (size_t i = 0; i < n_unknowns; i++) {
        const size_t size = size_of(unknowns[i]);
        if (size == 0) return fail(self, "fmi3GetDirectionalDerivative", "this is no unknown");
        if (j + size > n_sensitivity) return fail(self, "fmi3GetDirectionalDerivative", "too little room");
        memcpy(sensitivity + j, direction + unknowns[i], size * sizeof(double));
        j += size;
    }
    return k == n_seed && j == n_sensitivity ? fmi3OK : fail(self, "fmi3GetDirectionalDerivative", "too many values");
}

fmi3Status fmi3EnterStepMode(fmi3Instance instance)
{
    OPEN("fmi3EnterStepMode", STEPPING);
    return fmi3OK;
}

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 time, fmi3Float64 step, fmi3Boolean no_set_state,
                      fmi3Boolean *event_needed, fmi3Boolean *terminate, fmi3Boolean *early_return,
                      fmi3Float64 *last_time)
{
    (void)no_set_state;
    OPEN("fmi3DoStep", STEPPING);
    *event_needed = *terminate = *early_return = false;
    *last_time = self->model.time;
    if (!isfinite(step) || step < 0.0) return fail(self, "fmi3DoStep", "the step size is negative or not finite");
    if (!(fabs(time - self->model.time) <= TIME_TOLERANCE * fmax(1.0, fabs(time)))) {
        return fail(self, "fmi3DoStep", "the communication point is not where the last step ended");
    }
    if (step > 0.0 && model_step(&self->model, step) != 0) {
        self->phase = FAILED;
        return fail(self, "fmi3DoStep", "a joint position is not finite");
    }
    *last_time = self->model.time = time + step;
    return fmi3OK;
}
