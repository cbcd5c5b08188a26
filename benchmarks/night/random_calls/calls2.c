/* Random calls of every function of FMI 2.0, in any order, with bad references, counts, times and damaged states. */
#include "fmi2Functions.h"

#include "calls.h"

static fmi2Component instances[INSTANCES];
static double times[INSTANCES];
static fmi2FMUstate states[STATES];
static fmi2Byte *bytes;
static size_t n_bytes;
static size_t messages;

static void on_message(fmi2ComponentEnvironment environment, fmi2String name, fmi2Status status, fmi2String category,
                       fmi2String message, ...)
{
    (void)environment;
    (void)status;
    messages += strlen(name) + strlen(category) + strlen(message);
}

static const fmi2CallbackFunctions with_log = {on_message, calloc, free, NULL, NULL};
static const fmi2CallbackFunctions without_log = {NULL, calloc, free, NULL, NULL};

static int make(unsigned k)
{
    fmi2FreeInstance(instances[k]);
    const char *token = below(20) ? TOKEN : "{another}";
    const fmi2CallbackFunctions *callbacks = below(30) ? below(2) ? &with_log : &without_log : NULL;
    instances[k] = fmi2Instantiate(below(30) ? "arm" : NULL, below(2) ? fmi2CoSimulation : fmi2ModelExchange,
                                   below(30) ? token : NULL, NULL, callbacks, (int)below(2), (int)below(2));
    times[k] = 0.0;
    return instances[k] == NULL ? fmi2Error : fmi2OK;
}

static void begin(void)
{
    for (unsigned k = 0; k < INSTANCES; k++) make(k);
}

static void end(void)
{
    fmi2Component last = fmi2Instantiate("last", fmi2CoSimulation, TOKEN, NULL, &with_log, 0, 0);
    for (unsigned k = 0; k < STATES; k++) fmi2FreeFMUstate(last, &states[k]);
    for (unsigned k = 0; k < INSTANCES; k++) fmi2FreeInstance(instances[k]);
    fmi2FreeInstance(last);
    free(bytes);
}

static int access_values(fmi2Component instance, unsigned kind)
{
    const size_t count = few(), others = few();
    uint32_t *which = references(count), *knowns = references(others);
    double *values = numbers(count), *seed = numbers(others);
    int status = fmi2OK;
    switch (kind) {
    case 0: status = fmi2GetReal(instance, which, count, values); break;
    case 1: status = fmi2SetReal(instance, which, count, values); break;
    default: status = fmi2GetDirectionalDerivative(instance, which, count, knowns, others, seed, values); break;
    }
    free(which), free(knowns), free(values), free(seed);
    return status;
}

static int access_others(fmi2Component instance)
{
    const size_t count = few();
    uint32_t *which = references(count);
    fmi2Integer *whole = block(count * sizeof *whole);
    fmi2String *texts = block(count * sizeof *texts);
    double *values = numbers(count);
    for (size_t i = 0; i < count; i++) whole[i] = (int)below(3), texts[i] = "text";
    int status = fmi2OK;
    switch (below(8)) {
    case 0: status = fmi2GetInteger(instance, which, count, whole); break;
    case 1: status = fmi2GetBoolean(instance, which, count, whole); break;
    case 2: status = fmi2GetString(instance, which, count, texts); break;
    case 3: status = fmi2SetInteger(instance, which, count, whole); break;
    case 4: status = fmi2SetBoolean(instance, which, count, whole); break;
    case 5: status = fmi2SetString(instance, which, count, texts); break;
    case 6: status = fmi2SetRealInputDerivatives(instance, which, count, whole, values); break;
    default: status = fmi2GetRealOutputDerivatives(instance, which, count, whole, values); break;
    }
    free(which), free(whole), free(texts), free(values);
    return status;
}

static int use_state(fmi2Component instance)
{
    fmi2FMUstate *state = &states[below(STATES)];
    size_t size = 0;
    int status = fmi2OK;
    switch (below(6)) {
    case 0: return fmi2GetFMUstate(instance, state);
    case 1: return fmi2SetFMUstate(instance, *state);
    case 2: return fmi2FreeFMUstate(instance, state);
    case 3:
        status = fmi2SerializedFMUstateSize(instance, *state, &size);
        if (status != fmi2OK) return status;
        free(bytes);
        n_bytes = below(8) ? size : below((unsigned)size);
        bytes = calloc(n_bytes ? n_bytes : 1, 1);
        return fmi2SerializeFMUstate(instance, *state, bytes, n_bytes);
    case 4:
        for (unsigned i = 0; n_bytes && i < below(4); i++) bytes[below((unsigned)n_bytes)] ^= (char)(1u << below(8));
        if (n_bytes && below(20) == 0) memset(bytes + n_bytes / 2, 0xFF, n_bytes - n_bytes / 2);
        return fmi2OK;
    default: return fmi2DeSerializeFMUstate(instance, bytes, n_bytes, state);
    }
}

static int ask_status(fmi2Component instance)
{
    const fmi2StatusKind kind = (fmi2StatusKind)below(4);
    fmi2Status status;
    double real;
    int whole;
    fmi2String text;
    switch (below(6)) {
    case 0: return fmi2GetStatus(instance, kind, &status);
    case 1: return fmi2GetRealStatus(instance, kind, &real);
    case 2: return fmi2GetIntegerStatus(instance, kind, &whole);
    case 3: return fmi2GetBooleanStatus(instance, kind, &whole);
    case 4: return fmi2GetStringStatus(instance, kind, &text);
    default: return fmi2CancelStep(instance);
    }
}

static int exchange(fmi2Component instance)
{
    const size_t count = below(6) ? N_STATES : few();
    double *values = numbers(count);
    fmi2EventInfo info;
    int one, other, status = fmi2OK;
    switch (below(10)) {
    case 0: status = fmi2EnterEventMode(instance); break;
    case 1: status = fmi2NewDiscreteStates(instance, &info); break;
    case 2: status = fmi2EnterContinuousTimeMode(instance); break;
    case 3: status = fmi2CompletedIntegratorStep(instance, 1, &one, &other); break;
    case 4: status = fmi2SetTime(instance, number()); break;
    case 5: status = fmi2SetContinuousStates(instance, values, count); break;
    case 6: status = fmi2GetDerivatives(instance, values, count); break;
    case 7: status = fmi2GetEventIndicators(instance, values, count); break;
    case 8: status = fmi2GetContinuousStates(instance, values, count); break;
    default: status = fmi2GetNominalsOfContinuousStates(instance, values, count); break;
    }
    free(values);
    return status;
}

static int step(fmi2Component instance, unsigned k)
{
    const double time = below(4) ? times[k] : number(), size = below(4) ? 0.05 : number();
    const int status = fmi2DoStep(instance, time, size, 1);
    if (status == fmi2OK) times[k] = time + size;
    return status;
}

static int call(void)
{
    const unsigned k = below(INSTANCES);
    const fmi2Component instance = below(50) ? instances[k] : NULL;
    const fmi2String categories[] = {below(2) ? "logEvents" : "logAll"};
    switch (below(24)) {
    case 0: return below(40) ? fmi2OK : make(k);
    case 1: return fmi2SetupExperiment(instance, 0, 0.0, below(4) ? 0.0 : number(), (int)below(2), number());
    case 2: return fmi2EnterInitializationMode(instance);
    case 3: return fmi2ExitInitializationMode(instance);
    case 4: return below(20) ? fmi2OK : fmi2Terminate(instance);
    case 5: times[k] = 0.0; return below(8) ? fmi2OK : fmi2Reset(instance);
    case 6: return fmi2SetDebugLogging(instance, (int)below(2), below(2), categories);
    case 7: return (int)strlen(fmi2GetVersion()) + (int)strlen(fmi2GetTypesPlatform()) > 0 ? fmi2OK : fmi2Error;
    case 8: return access_others(instance);
    case 9: return ask_status(instance);
    case 10: case 11: return exchange(instance);
    case 12: case 13: case 14: return use_state(instance);
    case 15: case 16: case 17: return access_values(instance, 0);
    case 18: case 19: return access_values(instance, 1);
    case 20: return access_values(instance, 2);
    default: return step(instance, k);
    }
}
