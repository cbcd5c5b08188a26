/* FMI 2.0 for co-simulation and model exchange around `Model`. */
#include "fmi2Functions.h"
#include "instance.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* How far the master's time may be from the model's own, relative to its size. */
#define TIME_TOLERANCE 1e-6

typedef struct {
    Model model;
    Phase phase;
    fmi2Type type;
    fmi2Boolean logging;
    const fmi2CallbackFunctions *callbacks;
    char *name;
} Instance;

static fmi2Status report(const Instance *instance, fmi2Status status, const char *function, const char *message)
{
    const fmi2CallbackFunctions *callbacks = instance->callbacks;
    if (callbacks->logger != NULL && (instance->logging || status >= fmi2Error)) {
        char text[MESSAGE_SIZE];
        compose(text, function, message);
        callbacks->logger(callbacks->componentEnvironment, instance->name, status,
                          status >= fmi2Error ? "logStatusError" : "logStatusWarning", text);
    }
    return status;
}

static fmi2Status fail(Instance *instance, const char *function, const char *message)
{
    return report(instance, fmi2Error, function, message);
}

#define OPEN(function, phases)                                                                     \
    Instance *const instance = component;                                                          \
    if (instance == NULL) return fmi2Error;                                                        \
    if ((instance->phase & (phases)) == 0) return fail(instance, function, "not allowed in this phase")

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }

const char *fmi2GetVersion(void) { return fmi2Version; }

fmi2Status fmi2SetDebugLogging(fmi2Component component, fmi2Boolean on, size_t count, const fmi2String categories[])
{
    (void)count;
    (void)categories;
    OPEN("fmi2SetDebugLogging", ~0);
    instance->logging = on;
    return fmi2OK;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *callbacks, fmi2Boolean visible, fmi2Boolean logging)
{
    (void)resources;
    (void)visible;
    if (callbacks == NULL || name == NULL || guid == NULL) return NULL;
    Instance *instance = calloc(1, sizeof *instance);
    char *copy = malloc(strlen(name) + 1);
    if (instance == NULL || copy == NULL) {
        free(instance);
        free(copy);
        return NULL;
    }
    instance->name = strcpy(copy, name);
    instance->callbacks = callbacks;
    instance->logging = logging;
    instance->type = type;
    instance->phase = INSTANTIATED;
    if (strcmp(guid, TOKEN) != 0) {
        fail(instance, "fmi2Instantiate", "the GUID is not that of this model");
        fmi2FreeInstance(instance);
        return NULL;
    }
    model_reset(&instance->model);
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
    (void)stop_defined;
    (void)stop;
    OPEN("fmi2SetupExperiment", INSTANTIATED);
    if (!isfinite(start)) return fail(instance, "fmi2SetupExperiment", "the start time is not finite");
    instance->model.time = start;
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component component)
{
    OPEN("fmi2EnterInitializationMode", INSTANTIATED);
    model_start(&instance->model);
    instance->phase = INITIALISING;
    return fmi2OK;
}

fmi2Status fmi2ExitInitializationMode(fmi2Component component)
{
    OPEN("fmi2ExitInitializationMode", INITIALISING);
    if (model_has_empty_range(&instance->model)) {
        return fail(instance, "fmi2ExitInitializationMode", "joint_lower is not below joint_upper");
    }
    instance->phase = instance->type == fmi2CoSimulation ? STEPPING : IN_EVENT;
    return fmi2OK;
}

fmi2Status fmi2Terminate(fmi2Component component)
{
    OPEN("fmi2Terminate", RUNNING | FAILED);
    instance->phase = TERMINATED;
    return fmi2OK;
}

fmi2Status fmi2Reset(fmi2Component component)
{
    OPEN("fmi2Reset", ~0);
    model_reset(&instance->model);
    instance->phase = INSTANTIATED;
    return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component component, const fmi2ValueReference references[], size_t count, fmi2Real values[])
{
    OPEN("fmi2GetReal", INSTANTIATED | READABLE);
    for (size_t i = 0; i < count; i++) {
        const ModelStatus status = model_get(&instance->model, references[i], &values[i]);
        if (status != MODEL_OK) return fail(instance, "fmi2GetReal", explain(status));
    }
    return fmi2OK;
}

fmi2Status fmi2SetReal(fmi2Component component, const fmi2ValueReference references[], size_t count,
                       const fmi2Real values[])
{
    OPEN("fmi2SetReal", INSTANTIATED | INITIALISING | RUNNING);
    for (size_t i = 0; i < count; i++) {
        /* Integrators that know no other way may set states one by one. */
        const int is_state = references[i] >= OFFSET_JOINT_POSITION;
        const ModelStatus status = is_state && (instance->phase & (IN_EVENT | CONTINUOUS)) == 0 && references[i] < N_VALUES
                                       ? MODEL_NOT_SETTABLE
                                       : model_set(&instance->model, references[i], values[i]);
        if (status != MODEL_OK) return fail(instance, "fmi2SetReal", explain(status));
    }
    if (instance->phase & (INSTANTIATED | INITIALISING)) model_start(&instance->model);
    return fmi2OK;
}

/* The model has real variables only. */
#define NO_VARIABLES(name, type)                                                                                  \
    fmi2Status name(fmi2Component component, const fmi2ValueReference references[], size_t count, type values[]) \
    {                                                                                                             \
        (void)references;                                                                                         \
        (void)values;                                                                                             \
        OPEN(#name, ~0);                                                                                          \
        return count == 0 ? fmi2OK : fail(instance, #name, explain(MODEL_NO_SUCH_VARIABLE));                      \
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
    Snapshot *snapshot = snapshot_take(&instance->model, instance->phase);
    if (snapshot == NULL) return fail(instance, "fmi2GetFMUstate", "out of memory");
    free(*state);
    *state = snapshot;
    return fmi2OK;
}

fmi2Status fmi2SetFMUstate(fmi2Component component, fmi2FMUstate state)
{
    OPEN("fmi2SetFMUstate", ~0);
    if (state == NULL) return fail(instance, "fmi2SetFMUstate", "there is no state");
    const Snapshot *snapshot = state;
    memcpy(&instance->model, &snapshot->model, sizeof instance->model);
    instance->phase = snapshot->phase;
    return fmi2OK;
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
    if (state == NULL || size < sizeof(Snapshot)) return fail(instance, "fmi2SerializeFMUstate", "no state or no room");
    memcpy(bytes, state, sizeof(Snapshot));
    return fmi2OK;
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component component, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state)
{
    OPEN("fmi2DeSerializeFMUstate", ~0);
    Snapshot *snapshot = snapshot_read(bytes, size);
    if (snapshot == NULL) return fail(instance, "fmi2DeSerializeFMUstate", "these bytes are no state of this model");
    free(*state);
    *state = snapshot;
    return fmi2OK;
}

fmi2Status fmi2GetDirectionalDerivative(fmi2Component component, const fmi2ValueReference unknowns[], size_t n_unknowns,
                                        const fmi2ValueReference knowns[], size_t n_knowns, const fmi2Real seed[],
                                        fmi2Real sensitivity[])
{
    OPEN("fmi2GetDirectionalDerivative", INITIALISING | RUNNING);
    double direction[N_VALUES] = {0.0};
    for (size_t i = 0; i < n_knowns; i++) {
        if (knowns[i] >= N_SETTABLE) return fail(instance, "fmi2GetDirectionalDerivative", "this is no known");
        direction[knowns[i]] = seed[i];
    }
    model_derive(&instance->model, direction, instance->phase == INITIALISING);
    for (size_t i = 0; i < n_unknowns; i++) {
        if (unknowns[i] >= N_VALUES) return fail(instance, "fmi2GetDirectionalDerivative", "this is no unknown");
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
    return count == 0 ? fmi2OK : fail(instance, "fmi2SetRealInputDerivatives", "inputs are held, not interpolated");
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component component, const fmi2ValueReference references[], size_t count,
                                        const fmi2Integer orders[], fmi2Real values[])
{
    (void)references;
    (void)orders;
    (void)values;
    OPEN("fmi2GetRealOutputDerivatives", ~0);
    return count == 0 ? fmi2OK : fail(instance, "fmi2GetRealOutputDerivatives", "not provided");
}

fmi2Status fmi2DoStep(fmi2Component component, fmi2Real time, fmi2Real step, fmi2Boolean no_set_state)
{
    (void)no_set_state;
    OPEN("fmi2DoStep", STEPPING);
    if (!isfinite(step) || step < 0.0) return fail(instance, "fmi2DoStep", "the step size is negative or not finite");
    if (!(fabs(time - instance->model.time) <= TIME_TOLERANCE * fmax(1.0, fabs(time)))) {
        return fail(instance, "fmi2DoStep", "the communication point is not where the last step ended");
    }
    if (step > 0.0 && model_step(&instance->model, step) != 0) {
        instance->phase = FAILED;
        return fail(instance, "fmi2DoStep", "a joint position is not finite");
    }
    instance->model.time = time + step;
    return fmi2OK;
}

fmi2Status fmi2CancelStep(fmi2Component component)
{
    OPEN("fmi2CancelStep", ~0);
    return fail(instance, "fmi2CancelStep", "no step is ever pending");
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
    *value = instance->model.time;
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
    *value = instance->phase == TERMINATED ? fmi2True : fmi2False;
    return fmi2OK;
}

fmi2Status fmi2GetStringStatus(fmi2Component component, const fmi2StatusKind kind, fmi2String *value)
{
    (void)kind;
    (void)value;
    OPEN("fmi2GetStringStatus", ~0);
    return report(instance, fmi2Discard, "fmi2GetStringStatus", "not provided");
}

/* Model exchange */

fmi2Status fmi2EnterEventMode(fmi2Component component)
{
    OPEN("fmi2EnterEventMode", IN_EVENT | CONTINUOUS);
    instance->phase = IN_EVENT;
    return fmi2OK;
}

fmi2Status fmi2NewDiscreteStates(fmi2Component component, fmi2EventInfo *info)
{
    OPEN("fmi2NewDiscreteStates", IN_EVENT);
    memset(info, 0, sizeof *info);
    return fmi2OK;
}

fmi2Status fmi2EnterContinuousTimeMode(fmi2Component component)
{
    OPEN("fmi2EnterContinuousTimeMode", IN_EVENT | CONTINUOUS);
    instance->phase = CONTINUOUS;
    return fmi2OK;
}

fmi2Status fmi2CompletedIntegratorStep(fmi2Component component, fmi2Boolean no_set_state, fmi2Boolean *enter_event,
                                       fmi2Boolean *terminate)
{
    (void)no_set_state;
    OPEN("fmi2CompletedIntegratorStep", CONTINUOUS);
    *enter_event = fmi2False;
    *terminate = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2SetTime(fmi2Component component, fmi2Real time)
{
    OPEN("fmi2SetTime", IN_EVENT | CONTINUOUS);
    instance->model.time = time;
    return fmi2OK;
}

static fmi2Status check_count(Instance *instance, const char *function, size_t count, size_t wanted)
{
    return count == wanted ? fmi2OK : fail(instance, function, "wrong number of values");
}

fmi2Status fmi2SetContinuousStates(fmi2Component component, const fmi2Real states[], size_t count)
{
    OPEN("fmi2SetContinuousStates", IN_EVENT | CONTINUOUS);
    const fmi2Status status = check_count(instance, "fmi2SetContinuousStates", count, 2 * N_JOINTS);
    if (status == fmi2OK) model_set_states(&instance->model, states);
    return status;
}

static void copy_values(Instance *instance, size_t offset, fmi2Real values[])
{
    for (size_t i = 0; i < 2 * N_JOINTS; i++) model_get(&instance->model, offset + i, &values[i]);
}

fmi2Status fmi2GetDerivatives(fmi2Component component, fmi2Real derivatives[], size_t count)
{
    OPEN("fmi2GetDerivatives", RUNNING | TERMINATED);
    const fmi2Status status = check_count(instance, "fmi2GetDerivatives", count, 2 * N_JOINTS);
    if (status == fmi2OK) copy_values(instance, OFFSET_DER_JOINT_POSITION, derivatives);
    return status;
}

fmi2Status fmi2GetEventIndicators(fmi2Component component, fmi2Real indicators[], size_t count)
{
    (void)indicators;
    OPEN("fmi2GetEventIndicators", ~0);
    return check_count(instance, "fmi2GetEventIndicators", count, 0);
}

fmi2Status fmi2GetContinuousStates(fmi2Component component, fmi2Real states[], size_t count)
{
    OPEN("fmi2GetContinuousStates", READABLE);
    const fmi2Status status = check_count(instance, "fmi2GetContinuousStates", count, 2 * N_JOINTS);
    if (status == fmi2OK) copy_values(instance, OFFSET_JOINT_POSITION, states);
    return status;
}

fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component component, fmi2Real nominals[], size_t count)
{
    OPEN("fmi2GetNominalsOfContinuousStates", ~0);
    const fmi2Status status = check_count(instance, "fmi2GetNominalsOfContinuousStates", count, 2 * N_JOINTS);
    for (size_t i = 0; status == fmi2OK && i < count; i++) nominals[i] = 1.0;
    return status;
}
