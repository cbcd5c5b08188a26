#include "crane.h"

typedef struct {
    void (*log)(void *, const char *, int, const char *, const char *, ...);
    void *allocate, *release, *finished, *environment;
} Callbacks;

static const Callbacks *callbacks;

void *fmi2Instantiate(const char *name, int type, const char *guid, const char *resources, const Callbacks *given,
                      int visible, int logging)
{
    Crane *c = calloc(1, sizeof *c);
    callbacks = given;
    init(c);
    return c;
}

void fmi2FreeInstance(void *c) { free(c); }

int fmi2SetupExperiment(void *c, int a, double b, double start, int d, double e)
{
    ((Crane *)c)->time = start;
    return 0;
}

int fmi2EnterInitializationMode(void *c) { return ((Crane *)c)->quirk == NO_START ? 3 : 0; }

int fmi2ExitInitializationMode(void *c)
{
    place(c);
    return 0;
}

int fmi2Reset(void *c)
{
    init(c);
    return 0;
}

int fmi2SetReal(void *c, const unsigned *references, size_t n, const double *values)
{
    for (size_t i = 0; i < n; i++) *at(c, references[i]) = values[i];
    return 0;
}

int fmi2GetReal(void *c, const unsigned *references, size_t n, double *values)
{
    for (size_t i = 0; i < n; i++) values[i] = *at(c, references[i]);
    return 0;
}

int fmi2GetRealStatus(void *c, int kind, double *value)
{
    *value = ((Crane *)c)->time;
    return 0;
}

int fmi2DoStep(void *component, double time, double h, int unused)
{
    Crane *c = component;
    if (c->quirk == STEP_FAILS) {
        callbacks->log(callbacks->environment, "crane", 3, "error", "load %d kg is too heavy at %s", 900, "noon");
        return 3;
    }
    if (c->quirk == NO_PROGRESS) return 2;
    if (c->quirk == ENDS_HALF_WAY && h > 0.02) {
        move(c, h / 2);
        return 2;
    }
    move(c, h);
    return 0;
}
