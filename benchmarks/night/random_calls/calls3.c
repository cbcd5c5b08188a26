/* Random calls of the functions of FMI 3.0, in any order, with bad references, counts, times and damaged states. */
#include "fmi3Functions.h"

#include "calls.h"

static fmi3Instance instances[INSTANCES];
static double times[INSTANCES];
static fmi3FMUState states[STATES];
static fmi3Byte *bytes;
static size_t n_bytes;
static size_t messages;

static void on_message(fmi3InstanceEnvironment environment, fmi3Status status, fmi3String category, fmi3String message)
{
    (void)environment;
    (void)status;
    messages += strlen(category) + strlen(message);
}

static int make(unsigned k)
{
    fmi3FreeInstance(instances[k]);
    const char *token = below(20) ? TOKEN : "{another}";
    const char *name = below(30) ? "arm" : NULL;
    const fmi3LogMessageCallback log = below(2) ? on_message : NULL;
    token = below(30) ? token : NULL;
    instances[k] = below(2) ? fmi3InstantiateModelExchange(name, token, NULL, below(2), below(2), NULL, log)
                            : fmi3InstantiateCoSimulation(name, token, NULL, below(2), below(2), below(2), below(2),
                                                          NULL, 0, NULL, log, NULL);
    times[k] = 0.0;
    return instances[k] == NULL ? fmi3Error : fmi3OK;
}

static void begin(void)
{
    for (unsigned k = 0; k < INSTANCES; k++) make(k);
}

static void end(void)
{
    fmi3Instance last =
        fmi3InstantiateCoSimulation("last", TOKEN, NULL, 0, 0, 0, 0, NULL, 0, NULL, on_message, NULL);
    for (unsigned k = 0; k < STATES; k++) fmi3FreeFMUState(last, &states[k]);
    for (unsigned k = 0; k < INSTANCES; k++) fmi3FreeInstance(instances[k]);
    fmi3FreeInstance(last);
    free(bytes);
}

/* Start of a group of values, as every valid reference is. */
static const struct {
    unsigned offset;
    unsigned size;
} groups[N_GROUPS] = GROUPS;

static size_t aim(uint32_t *which, size_t count)
{
    size_t size = 0;
    for (size_t i = 0; i < count; i++) {
        const unsigned group = below(N_GROUPS);
        if (below(10)) which[i] = groups[group].offset;
        size += which[i] == N_VALUES ? 1 : groups[group].size;
    }
    return below(8) ? size : few();
}

static int access_values(fmi3Instance instance, unsigned kind)
{
    const size_t count = few(), others = few();
    uint32_t *which = references(count), *knowns = references(others);
    const size_t n_values = aim(which, count), n_seed = aim(knowns, others);
    double *values = numbers(n_values), *seed = numbers(n_seed);
    int status = fmi3OK;
    switch (kind) {
    case 0: status = fmi3GetFloat64(instance, which, count, values, n_values); break;
    case 1: status = fmi3SetFloat64(instance, which, count, values, n_values); break;
    case 2:
        status = fmi3GetDirectionalDerivative(instance, which, count, knowns, others, seed, n_seed, values, n_values);
        break;
    default:
        status = fmi3GetAdjointDerivative(instance, knowns, others, which, count, seed, n_seed, values, n_values);
        break;
    }
    free(which), free(knowns), free(values), free(seed);
    return status;
}

static int access_others(fmi3Instance instance)
{
    const size_t count = few();
    uint32_t *which = references(count);
    void *values = block(count * 8);
    if (values != NULL) memset(values, 0, count * 8);
    int status = fmi3OK;
    switch (below(8)) {
    case 0: status = fmi3GetFloat32(instance, which, count, values, count); break;
    case 1: status = fmi3SetInt32(instance, which, count, values, count); break;
    case 2: status = fmi3GetUInt64(instance, which, count, values, count); break;
    case 3: status = fmi3SetBoolean(instance, which, count, values, count); break;
    case 4: status = fmi3GetInt8(instance, which, count, values, count); break;
    case 5: status = fmi3SetUInt16(instance, which, count, values, count); break;
    case 6: status = fmi3GetString(instance, which, count, values, count); break;
    default: status = fmi3SetFloat32(instance, which, count, values, count); break;
    }
    free(which), free(values);
    return status;
}

static int use_state(fmi3Instance instance)
{
    fmi3FMUState *state = &states[below(STATES)];
    size_t size = 0;
    int status = fmi3OK;
    switch (below(6)) {
    case 0: return fmi3GetFMUState(instance, state);
    case 1: return fmi3SetFMUState(instance, *state);
    case 2: return fmi3FreeFMUState(instance, state);
    case 3:
        status = fmi3SerializedFMUStateSize(instance, *state, &size);
        if (status != fmi3OK) return status;
        free(bytes);
        n_bytes = below(8) ? size : below((unsigned)size);
        bytes = calloc(n_bytes ? n_bytes : 1, 1);
        return fmi3SerializeFMUState(instance, *state, bytes, n_bytes);
    case 4:
        for (unsigned i = 0; n_bytes && i < below(4); i++) bytes[below((unsigned)n_bytes)] ^= (fmi3Byte)(1u << below(8));
        if (n_bytes && below(20) == 0) memset(bytes + n_bytes / 2, 0xFF, n_bytes - n_bytes / 2);
        return fmi3OK;
    default: return fmi3DeserializeFMUState(instance, bytes, n_bytes, state);
    }
}

static int exchange(fmi3Instance instance)
{
    const size_t count = below(6) ? N_STATES : few();
    double *values = numbers(count), time;
    size_t size;
    bool b[5];
    int status = fmi3OK;
    switch (below(12)) {
    case 0: status = fmi3EnterEventMode(instance); break;
    case 1: status = fmi3UpdateDiscreteStates(instance, &b[0], &b[1], &b[2], &b[3], &b[4], &time); break;
    case 2: status = fmi3EnterContinuousTimeMode(instance); break;
    case 3: status = fmi3CompletedIntegratorStep(instance, true, &b[0], &b[1]); break;
    case 4: status = fmi3SetTime(instance, number()); break;
    case 5: status = fmi3SetContinuousStates(instance, values, count); break;
    case 6: status = fmi3GetContinuousStateDerivatives(instance, values, count); break;
    case 7: status = fmi3GetEventIndicators(instance, values, count); break;
    case 8: status = fmi3GetContinuousStates(instance, values, count); break;
    case 9: status = fmi3GetNumberOfContinuousStates(instance, &size); break;
    case 10: status = fmi3GetNumberOfEventIndicators(instance, &size); break;
    default: status = fmi3GetNominalsOfContinuousStates(instance, values, count); break;
    }
    free(values);
    return status;
}

static int step(fmi3Instance instance, unsigned k)
{
    const double time = below(4) ? times[k] : number(), size = below(4) ? 0.05 : number();
    bool event, terminate, early;
    double last;
    const int status = fmi3DoStep(instance, time, size, below(2), &event, &terminate, &early, &last);
    if (status == fmi3OK) times[k] = last;
    return status;
}

static int call(void)
{
    const unsigned k = below(INSTANCES);
    const fmi3Instance instance = below(50) ? instances[k] : NULL;
    const fmi3String categories[] = {below(2) ? "logEvents" : "logAll"};
    switch (below(24)) {
    case 0: return below(40) ? fmi3OK : make(k);
    case 1: return fmi3EnterInitializationMode(instance, 0, 0.0, below(4) ? 0.0 : number(), below(2), number());
    case 2: return fmi3ExitInitializationMode(instance);
    case 3: return below(20) ? fmi3OK : fmi3Terminate(instance);
    case 4: times[k] = 0.0; return below(8) ? fmi3OK : fmi3Reset(instance);
    case 5: return fmi3SetDebugLogging(instance, below(2), below(2), categories);
    case 6: return strlen(fmi3GetVersion()) > 0 ? fmi3OK : fmi3Error;
    case 7: return access_others(instance);
    case 8: return fmi3EnterStepMode(instance);
    case 9: case 10: case 11: return use_state(instance);
    case 12: case 13: case 14: return access_values(instance, 0);
    case 15: case 16: return access_values(instance, 1);
    case 17: return access_values(instance, 2 + below(2));
    case 18: case 19: return exchange(instance);
    default: return step(instance, k);
    }
}
