/* FMI 2.0 around `Model`: both interfaces, but for the functions that FMI 3 shares. */
#include "fmi2Functions.h"
#include "instance.h"

#include <stdlib.h>
#include <string.h>

typedef struct {
    Core core;
    unsigned logged; /* bits of categories; errors are always logged */
    const fmi2CallbackFunctions *callbacks;
    char name[];
} Instance;

static void tell(const Instance *instance, fmi2Status status, const char *category, const char *text)
{
    const fmi2CallbackFunctions *callbacks = instance->callbacks;
    if (callbacks->logger == NULL) return;
    callbacks->logger(callbacks->componentEnvironment, instance->name, status, category, text);
}

typedef fmi2Component Handle;
typedef fmi2Status Status;
typedef fmi2Boolean Boolean;
typedef fmi2String String;
typedef fmi2Byte Byte;
typedef fmi2FMUstate State;

#define FMI(name) fmi2##name
#define FMI_STATE(verb, noun) fmi2##verb##FMUstate##noun
#define DESERIALIZE_STATE fmi2DeSerializeFMUstate
#define GET_DERIVATIVES fmi2GetDerivatives
#define DERIVATIVE_PHASES (RUNNING | TERMINATED)
#define TOKEN_NAME "GUID"
#include "shared_functions.h"

size_t size_of(unsigned reference) { return reference < N_VALUES; }

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *callbacks, fmi2Boolean visible, fmi2Boolean logging)
{
    if (callbacks == NULL || name == NULL || guid == NULL) return NULL;
    const size_t size = strlen(name) + 1;
    Instance *instance = calloc(1, sizeof *instance + size);
    if (instance == NULL) return NULL;
    memcpy(instance->name, name, size);
    instance->callbacks = callbacks;
    return open_instance(instance, __func__, guid, type == fmi2ModelExchange, logging);
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
    return ANSWER(core_get(&self->core, (Variables){references, count, count}, values));
}

fmi2Status fmi2SetReal(fmi2Component instance, const fmi2ValueReference references[], size_t count,
                       const fmi2Real values[])
{
    OPEN(STARTING | RUNNING);
    return ANSWER(core_set(&self->core, (Variables){references, count, count}, values));
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
    const Variables rows = {unknowns, n_unknowns, n_unknowns}, columns = {knowns, n_knowns, n_knowns};
    return ANSWER(core_derive(&self->core, rows, columns, seed, sensitivity));
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
    const char *message = model_settle(&self->core.model, &states_changed);
    memset(info, 0, sizeof *info);
    info->valuesOfContinuousStatesChanged = states_changed;
    report_events(self);
    return ANSWER(message);
}
