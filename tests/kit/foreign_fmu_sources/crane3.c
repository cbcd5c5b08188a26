#include "crane.h"

typedef void (*Log)(void *, int, const char *, const char *);

static Log log_message;

void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources, bool visible,
                                  bool logging, bool event_mode, bool early, const unsigned *intermediate, size_t n,
                                  void *environment, Log log, void *update)
{
    Crane *c = calloc(1, sizeof *c);
    log_message = log;
    init(c);
    if (logging) log(environment, 0, "all", "crane number 7");
    return c;
}

void fmi3FreeInstance(void *c)
{
    called_after_fatal += dead;
    free(c);
}

int fmi3Terminate(void *c)
{
    called_after_fatal += dead;
    terminated++;
    return 0;
}

int fmi3EnterInitializationMode(void *c, bool a, double b, double start, bool d, double e)
{
    ((Crane *)c)->time = start;
    if (a && b == 0.001) log_message(NULL, 0, "all", "tolerance 0.001");
    return ((Crane *)c)->quirk == NO_START ? 3 : 0;
}

int fmi3ExitInitializationMode(void *c)
{
    place(c);
    return 0;
}

int fmi3Reset(void *c)
{
    init(c);
    return 0;
}

static int copy(Crane *c, const unsigned *references, size_t n, double *values, size_t n_values, bool out)
{
    size_t k = 0;
    for (size_t i = 0; i < n; i++) {
        if (references[i] == 130) { /* as many samples as configured */
            for (unsigned j = 0; j < c->samples; j++, k++) values[k] = c->place[0] + j;
            continue;
        }
        for (unsigned j = 0; j < (references[i] == 50 ? 1 : 2); j++, k++) {
            if (k == n_values) return 3;
            if (out) values[k] = at(c, references[i])[j];
            else at(c, references[i])[j] = values[k];
        }
    }
    return k == n_values ? 0 : 3;
}

int fmi3SetFloat64(void *c, const unsigned *references, size_t n, const double *values, size_t n_values)
{
    return copy(c, references, n, (double *)values, n_values, false);
}

int fmi3GetFloat64(void *c, const unsigned *references, size_t n, double *values, size_t n_values)
{
    return copy(c, references, n, values, n_values, true);
}

#define SETTER(Type, type, wanted, field)                                                                  \
    int fmi3Set##Type(void *c, const unsigned *references, size_t n, const type *values, size_t n_values) \
    {                                                                                                      \
        ((Crane *)c)->field = values[0];                                                                   \
        return n == 1 && n_values == 1 && references[0] == wanted ? 0 : 3;                                 \
    }

SETTER(Int8, signed char, 70, gear)
SETTER(Boolean, bool, 80, on)
SETTER(Float32, float, 100, trim)

int fmi3SetString(void *c, const unsigned *references, size_t n, const char *const values[], size_t n_values)
{
    return references[0] == 90 && n_values == 1 ? set_mood(c, n, values) : 3;
}

int fmi3GetFloat32(void *component, const unsigned *references, size_t n, float *values, size_t n_values)
{
    Crane *c = component;
    for (size_t i = 0; i < n_values; i++) values[i] = (float)c->place[i];
    return n == 1 && n_values == 2 && references[0] == 110 ? 0 : 3;
}

int fmi3EnterConfigurationMode(void *c)
{
    ((Crane *)c)->configuring = true;
    return 0;
}

int fmi3ExitConfigurationMode(void *c)
{
    ((Crane *)c)->configuring = false;
    return 0;
}

int fmi3SetUInt64(void *component, const unsigned *references, size_t n, const unsigned long long *values, size_t n_values)
{
    Crane *c = component;
    c->samples = values[0];
    return c->configuring && n == 1 && n_values == 1 && references[0] == 120 ? 0 : 3;
}

int fmi3DoStep(void *component, double time, double h, bool unused, bool *event, bool *end, bool *early, double *last)
{
    Crane *c = component;
    *event = *end = *early = false;
    *last = time;
    called_after_fatal += dead;
    if (c->quirk == DIES) {
        dead = true;
        return 4;
    }
    if (c->quirk == STEP_FAILS) {
        log_message(0, 3, "error", "load 900 kg is too heavy at noon");
        return 3;
    }
    if (c->quirk == NO_PROGRESS) *early = true;
    else if (c->quirk == ENDS_SIMULATION) *end = true;
    else if (c->quirk == ENDS_HALF_WAY && h > 0.02) {
        move(c, h / 2);
        *early = true;
    } else if (c->quirk == CREEPS && h > 1e-5) {
        move(c, 1e-5);
        *early = true;
    } else move(c, h);
    *last = c->time;
    return 0;
}
