/* FMI 3.0 around `Model`: both interfaces, but for the functions that FMI 2 shares; variables are arrays of doubles. */
#include "fmi3Functions.h"
#include "instance.h"

#include <stdlib.h>

typedef struct {
    Core core;
    unsigned logged; /* bits of categories; errors are always logged */
    fmi3LogMessageCallback log;
    fmi3InstanceEnvironment environment;
} Instance;

static void tell(const Instance *instance, fmi3Status status, const char *category, const char *text)
{
    if (instance->log != NULL) instance->log(instance->environment, status, category, text);
}

typedef fmi3Instance Handle;
typedef fmi3Status Status;
typedef fmi3Boolean Boolean;
typedef fmi3String String;
typedef fmi3Byte Byte;
typedef fmi3FMUState State;

#define FMI(name) fmi3##name
#define FMI_STATE(verb, noun) fmi3##verb##FMUState##noun
#define DESERIALIZE_STATE fmi3DeserializeFMUState
#define GET_DERIVATIVES fmi3GetContinuousStateDerivatives
#define DERIVATIVE_PHASES READABLE
#define TOKEN_NAME "token"
#include "shared_functions.h"

static const struct {
    unsigned offset;
    unsigned size;
} groups[N_GROUPS] = GROUPS;

size_t size_of(unsigned reference)
{
    for (size_t i = 0; i < N_GROUPS; i++) {
        if (groups[i].offset == reference) return groups[i].size;
    }
    return reference == N_VALUES; /* the independent variable */
}

static Instance *instantiate(const char *function, fmi3String token, int exchange, fmi3Boolean logging,
                             fmi3InstanceEnvironment environment, fmi3LogMessageCallback log)
{
    Instance *instance = calloc(1, sizeof *instance);
    if (instance == NULL) return NULL;
    instance->log = log;
    instance->environment = environment;
    return open_instance(instance, function, token, exchange, logging);
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                         fmi3Boolean logging, fmi3Boolean event_mode, fmi3Boolean early_return,
                                         const fmi3ValueReference intermediate[], size_t n_intermediate,
                                         fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                         fmi3IntermediateUpdateCallback update)
{
    return instantiate(__func__, token, 0, logging, environment, log);
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                          fmi3Boolean logging, fmi3InstanceEnvironment environment,
                                          fmi3LogMessageCallback log)
{
    return instantiate(__func__, token, 1, logging, environment, log);
}

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
    return ANSWER(core_get(&self->core, (Variables){references, count, n_values}, values));
}

fmi3Status fmi3SetFloat64(fmi3Instance instance, const fmi3ValueReference references[], size_t count,
                          const fmi3Float64 values[], size_t n_values)
{
    OPEN(STARTING | RUNNING);
    return ANSWER(core_set(&self->core, (Variables){references, count, n_values}, values));
}

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance instance, const fmi3ValueReference unknowns[], size_t n_unknowns,
                                        const fmi3ValueReference knowns[], size_t n_knowns, const fmi3Float64 seed[],
                                        size_t n_seed, fmi3Float64 sensitivity[], size_t n_sensitivity)
{
    OPEN(DIFFERENTIABLE);
    const Variables rows = {unknowns, n_unknowns, n_sensitivity}, columns = {knowns, n_knowns, n_seed};
    return ANSWER(core_derive(&self->core, rows, columns, seed, sensitivity));
}

fmi3Status fmi3GetAdjointDerivative(fmi3Instance instance, const fmi3ValueReference unknowns[], size_t n_unknowns,
                                        const fmi3ValueReference knowns[], size_t n_knowns, const fmi3Float64 seed[],
                                        size_t n_seed, fmi3Float64 sensitivity[], size_t n_sensitivity)
{
    OPEN(DIFFERENTIABLE);
    const Variables rows = {unknowns, n_unknowns, n_seed}, columns = {knowns, n_knowns, n_sensitivity};
    return ANSWER(core_derive_adjoint(&self->core, rows, columns, seed, sensitivity));
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
    const char *message = model_settle(&self->core.model, &changed);
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

/* Functions that FMI 3.0 requires of every library and this model does not have: other types, clocks, interfaces. */

#define ABSENT_VARIABLES(name, type)                                                                             \
    fmi3Status name(fmi3Instance instance, const fmi3ValueReference references[], size_t count, type values[],   \
                    size_t n_values)                                                                             \
    {                                                                                                            \
        OPEN(~0);                                                                                                \
        return ANSWER(count == 0 ? NULL : "the model has Float64 variables only");                               \
    }
#define ABSENT_TYPE(Type)                             \
    ABSENT_VARIABLES(fmi3Get##Type, fmi3##Type)       \
    ABSENT_VARIABLES(fmi3Set##Type, const fmi3##Type)

ABSENT_TYPE(Float32)
ABSENT_TYPE(Int8)
ABSENT_TYPE(UInt8)
ABSENT_TYPE(Int16)
ABSENT_TYPE(UInt16)
ABSENT_TYPE(Int32)
ABSENT_TYPE(UInt32)
ABSENT_TYPE(Int64)
ABSENT_TYPE(UInt64)
ABSENT_TYPE(Boolean)
ABSENT_TYPE(String)

/* Functions of capabilities that this model does not have: they always fail. */
#define ABSENT(name, ...)                                     \
    fmi3Status fmi3##name(__VA_ARGS__)                        \
    {                                                         \
        OPEN(~0);                                             \
        return ANSWER("this FMU has no such capability");     \
    }

typedef const fmi3ValueReference Reference;
typedef fmi3IntervalQualifier Qualifier;

ABSENT(GetBinary, Handle instance, Reference r[], size_t n, size_t sizes[], fmi3Binary v[], size_t nv)
ABSENT(SetBinary, Handle instance, Reference r[], size_t n, const size_t sizes[], const fmi3Binary v[], size_t nv)
ABSENT(GetClock, Handle instance, Reference r[], size_t n, fmi3Clock v[])
ABSENT(SetClock, Handle instance, Reference r[], size_t n, const fmi3Clock v[])
ABSENT(GetNumberOfVariableDependencies, Handle instance, fmi3ValueReference r, size_t *n)
ABSENT(GetVariableDependencies, Handle instance, fmi3ValueReference r, size_t e[], fmi3ValueReference d[], size_t f[],
       fmi3DependencyKind k[], size_t n)
ABSENT(EnterConfigurationMode, Handle instance)
ABSENT(ExitConfigurationMode, Handle instance)
ABSENT(GetIntervalDecimal, Handle instance, Reference r[], size_t n, fmi3Float64 v[], Qualifier q[])
ABSENT(GetIntervalFraction, Handle instance, Reference r[], size_t n, fmi3UInt64 c[], fmi3UInt64 s[], Qualifier q[])
ABSENT(GetShiftDecimal, Handle instance, Reference r[], size_t n, fmi3Float64 v[])
ABSENT(GetShiftFraction, Handle instance, Reference r[], size_t n, fmi3UInt64 c[], fmi3UInt64 s[])
ABSENT(SetIntervalDecimal, Handle instance, Reference r[], size_t n, const fmi3Float64 v[])
ABSENT(SetIntervalFraction, Handle instance, Reference r[], size_t n, const fmi3UInt64 c[], const fmi3UInt64 s[])
ABSENT(SetShiftDecimal, Handle instance, Reference r[], size_t n, const fmi3Float64 v[])
ABSENT(SetShiftFraction, Handle instance, Reference r[], size_t n, const fmi3UInt64 c[], const fmi3UInt64 s[])
ABSENT(EvaluateDiscreteStates, Handle instance)
ABSENT(GetOutputDerivatives, Handle instance, Reference r[], size_t n, const fmi3Int32 o[], fmi3Float64 v[], size_t nv)
ABSENT(ActivateModelPartition, Handle instance, fmi3ValueReference r, fmi3Float64 t)

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String path, fmi3Boolean visible,
                                               fmi3Boolean logging, fmi3InstanceEnvironment e,
                                               fmi3LogMessageCallback log, fmi3ClockUpdateCallback update,
                                               fmi3LockPreemptionCallback lock, fmi3UnlockPreemptionCallback unlock)
{
    return NULL;
}
