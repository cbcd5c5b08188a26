/* Functions that FMI 3.0 requires of every library and this model does not have: other types, clocks, interfaces. */
#include "fmi3_instance.h"

/* In any phase: the model has nothing of the kind. */
static fmi3Status refuse(const Instance *instance, const char *function, const char *message)
{
    return instance == NULL ? fmi3Error : answer(instance, function, message);
}

#define ABSENT_TYPE(Type)                                                                                            \
    fmi3Status fmi3Get##Type(fmi3Instance instance, const fmi3ValueReference references[], size_t count,             \
                             fmi3##Type values[], size_t n_values)                                                   \
    {                                                                                                                \
        return refuse(instance, "fmi3Get" #Type, count == 0 ? NULL : "the model has Float64 variables only");        \
    }                                                                                                                \
    fmi3Status fmi3Set##Type(fmi3Instance instance, const fmi3ValueReference references[], size_t count,             \
                             const fmi3##Type values[], size_t n_values)                                             \
    {                                                                                                                \
        return refuse(instance, "fmi3Set" #Type, count == 0 ? NULL : "the model has Float64 variables only");        \
    }

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
#define ABSENT(name, ...) \
    fmi3Status name(__VA_ARGS__) { return refuse(i, #name, "this FMU has no such capability"); }

typedef const fmi3ValueReference Reference;
typedef fmi3IntervalQualifier Qualifier;

ABSENT(fmi3GetBinary, fmi3Instance i, Reference r[], size_t n, size_t sizes[], fmi3Binary v[], size_t nv)
ABSENT(fmi3SetBinary, fmi3Instance i, Reference r[], size_t n, const size_t sizes[], const fmi3Binary v[], size_t nv)
ABSENT(fmi3GetClock, fmi3Instance i, Reference r[], size_t n, fmi3Clock v[])
ABSENT(fmi3SetClock, fmi3Instance i, Reference r[], size_t n, const fmi3Clock v[])
ABSENT(fmi3GetNumberOfVariableDependencies, fmi3Instance i, fmi3ValueReference r, size_t *n)
ABSENT(fmi3GetVariableDependencies, fmi3Instance i, fmi3ValueReference r, size_t e[], fmi3ValueReference d[], size_t f[],
       fmi3DependencyKind k[], size_t n)
ABSENT(fmi3EnterConfigurationMode, fmi3Instance i)
ABSENT(fmi3ExitConfigurationMode, fmi3Instance i)
ABSENT(fmi3GetIntervalDecimal, fmi3Instance i, Reference r[], size_t n, fmi3Float64 v[], Qualifier q[])
ABSENT(fmi3GetIntervalFraction, fmi3Instance i, Reference r[], size_t n, fmi3UInt64 c[], fmi3UInt64 s[], Qualifier q[])
ABSENT(fmi3GetShiftDecimal, fmi3Instance i, Reference r[], size_t n, fmi3Float64 v[])
ABSENT(fmi3GetShiftFraction, fmi3Instance i, Reference r[], size_t n, fmi3UInt64 c[], fmi3UInt64 s[])
ABSENT(fmi3SetIntervalDecimal, fmi3Instance i, Reference r[], size_t n, const fmi3Float64 v[])
ABSENT(fmi3SetIntervalFraction, fmi3Instance i, Reference r[], size_t n, const fmi3UInt64 c[], const fmi3UInt64 s[])
ABSENT(fmi3SetShiftDecimal, fmi3Instance i, Reference r[], size_t n, const fmi3Float64 v[])
ABSENT(fmi3SetShiftFraction, fmi3Instance i, Reference r[], size_t n, const fmi3UInt64 c[], const fmi3UInt64 s[])
ABSENT(fmi3EvaluateDiscreteStates, fmi3Instance i)
ABSENT(fmi3GetOutputDerivatives, fmi3Instance i, Reference r[], size_t n, const fmi3Int32 o[], fmi3Float64 v[], size_t nv)
ABSENT(fmi3ActivateModelPartition, fmi3Instance i, fmi3ValueReference r, fmi3Float64 t)

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String path, fmi3Boolean visible,
                                               fmi3Boolean logging, fmi3InstanceEnvironment e,
                                               fmi3LogMessageCallback log, fmi3ClockUpdateCallback update,
                                               fmi3LockPreemptionCallback lock, fmi3UnlockPreemptionCallback unlock)
{
    return NULL;
}
