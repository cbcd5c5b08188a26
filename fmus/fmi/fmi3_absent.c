/* What FMI 3.0 asks every library to export and this model does not have: other types, clocks, other interfaces. */
#ifdef __GNUC__
#pragma GCC diagnostic ignored "-Wunused-parameter" /* that is what absent means */
#endif
#include "fmi3Functions.h"

#include <stddef.h>

#define ABSENT_TYPE(Type)                                                                                            \
    fmi3Status fmi3Get##Type(fmi3Instance instance, const fmi3ValueReference references[], size_t count,             \
                             fmi3##Type values[], size_t n_values)                                                   \
    {                                                                                                                \
        return instance != NULL && count == 0 ? fmi3OK : fmi3Error;                                                  \
    }                                                                                                                \
    fmi3Status fmi3Set##Type(fmi3Instance instance, const fmi3ValueReference references[], size_t count,             \
                             const fmi3##Type values[], size_t n_values)                                             \
    {                                                                                                                \
        return instance != NULL && count == 0 ? fmi3OK : fmi3Error;                                                  \
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

/* Functions of which this model has no use: they fail, whatever they are given. */
#define ABSENT(name, ...) \
    fmi3Status name(__VA_ARGS__) { return fmi3Error; }

typedef const fmi3ValueReference Reference;
typedef fmi3IntervalQualifier Qualifier;

ABSENT(fmi3GetBinary, fmi3Instance i, Reference r[], size_t n, size_t sizes[], fmi3Binary v[], size_t nv)
ABSENT(fmi3SetBinary, fmi3Instance i, Reference r[], size_t n, const size_t sizes[], const fmi3Binary v[], size_t nv)
ABSENT(fmi3GetClock, fmi3Instance i, Reference r[], size_t n, fmi3Clock v[])
ABSENT(fmi3SetClock, fmi3Instance i, Reference r[], size_t n, const fmi3Clock v[])
ABSENT(fmi3GetNumberOfVariableDependencies, fmi3Instance i, fmi3ValueReference r, size_t *n)
ABSENT(fmi3GetVariableDependencies, fmi3Instance i, fmi3ValueReference r, size_t e[], fmi3ValueReference d[], size_t f[],
       fmi3DependencyKind k[], size_t n)
ABSENT(fmi3GetAdjointDerivative, fmi3Instance i, Reference u[], size_t nu, Reference k[], size_t nk,
       const fmi3Float64 seed[], size_t ns, fmi3Float64 sensitivity[], size_t n)
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
ABSENT(fmi3UpdateDiscreteStates, fmi3Instance i, fmi3Boolean *a, fmi3Boolean *b, fmi3Boolean *c, fmi3Boolean *d,
       fmi3Boolean *e, fmi3Float64 *t)
ABSENT(fmi3EnterEventMode, fmi3Instance i)
ABSENT(fmi3EnterContinuousTimeMode, fmi3Instance i)
ABSENT(fmi3CompletedIntegratorStep, fmi3Instance i, fmi3Boolean a, fmi3Boolean *b, fmi3Boolean *c)
ABSENT(fmi3SetTime, fmi3Instance i, fmi3Float64 t)
ABSENT(fmi3SetContinuousStates, fmi3Instance i, const fmi3Float64 v[], size_t n)
ABSENT(fmi3GetContinuousStateDerivatives, fmi3Instance i, fmi3Float64 v[], size_t n)
ABSENT(fmi3GetEventIndicators, fmi3Instance i, fmi3Float64 v[], size_t n)
ABSENT(fmi3GetContinuousStates, fmi3Instance i, fmi3Float64 v[], size_t n)
ABSENT(fmi3GetNominalsOfContinuousStates, fmi3Instance i, fmi3Float64 v[], size_t n)
ABSENT(fmi3GetNumberOfEventIndicators, fmi3Instance i, size_t *n)
ABSENT(fmi3GetNumberOfContinuousStates, fmi3Instance i, size_t *n)
ABSENT(fmi3GetOutputDerivatives, fmi3Instance i, Reference r[], size_t n, const fmi3Int32 o[], fmi3Float64 v[], size_t nv)
ABSENT(fmi3ActivateModelPartition, fmi3Instance i, fmi3ValueReference r, fmi3Float64 t)

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String path, fmi3Boolean visible,
                                          fmi3Boolean logging, fmi3InstanceEnvironment e, fmi3LogMessageCallback log)
{
    return NULL;
}

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String path, fmi3Boolean visible,
                                               fmi3Boolean logging, fmi3InstanceEnvironment e,
                                               fmi3LogMessageCallback log, fmi3ClockUpdateCallback update,
                                               fmi3LockPreemptionCallback lock, fmi3UnlockPreemptionCallback unlock)
{
    return NULL;
}
