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
    if (logging) given->log(given->environment, name, 0, "all", "crane number %d", 7);
    return c;
}

void fmi2FreeInstance(void *c)
{
    called_after_fatal += dead;
    free(c);
}

int fmi2Terminate(void *c)
{
    called_after_fatal += dead;
    terminated++;
    return 0;
}

int fmi2SetupExperiment(void *c, int a, double b, double start, int d, double e)
{
    ((Crane *)c)->time = start;
    if (a) callbacks->log(callbacks->environment, "crane", 0, "all", "tolerance %g", b);
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

int fmi2SetInteger(void *c, const unsigned *references, size_t n, const int *values)
{
    if (n > 0) ((Crane *)c)->gear = values[0];
    return n == 0 || (n == 1 && references[0] == 70) ? 0 : 3;
}

int fmi2SetBoolean(void *c, const unsigned *references, size_t n, const int *values)
{
    if (n > 0) ((Crane *)c)->on = values[0] != 0;
    return n == 0 || (n == 1 && references[0] == 80) ? 0 : 3;
}

int fmi2SetString(void *c, const unsigned *references, size_t n, const char *const values[])
{
    return n == 0 ? 0 : references[0] == 90 ? set_mood(c, n, values) : 3;
}

int fmi2GetReal(void *component, const unsigned *references, size_t n, double *values)
{
    Crane *c = component;
    place(c);
    for (int i = 0; i < 2; i++) c->rate[i] = c->push[i];
    for (size_t i = 0; i < n; i++) values[i] = *at(c, references[i]);
    return 0;
}

int fmi2GetBoolean(void *component, const unsigned *references, size_t n, int *values)
{
    for (size_t i = 0; i < n; i++) values[i] = ((Crane *)component)->on;
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
    called_after_fatal += dead;
    if (c->quirk == DIES) {
        dead = true;
        return 4;
    }
    if (c->quirk == NO_PROGRESS) return 2;
    if (c->quirk == ENDS_HALF_WAY && h > 0.02) {
        move(c, h / 2);
        return 2;
    }
    if (c->quirk == CREEPS && h > 1e-5) {
        move(c, 1e-5);
        return 2;
    }
    move(c, h);
    return 0;
}

/* Model exchange: d(wheel)/dt = rate = push. */

typedef struct {
    int repeat, terminate, nominals, values, has_next;
    double next;
} EventInfo;

int fmi2EnterEventMode(void *c) { return 0; }

int fmi2NewDiscreteStates(void *c, EventInfo *info)
{
    *info = (EventInfo){0};
    return 0;
}

int fmi2EnterContinuousTimeMode(void *c) { return 0; }

int fmi2CompletedIntegratorStep(void *c, int no_set_state, int *event, int *terminate)
{
    *event = *terminate = 0;
    return 0;
}

int fmi2SetTime(void *c, double time)
{
    ((Crane *)c)->time = time;
    return 0;
}

int fmi2SetContinuousStates(void *c, const double *states, size_t n)
{
    for (size_t i = 0; i < n; i++) ((Crane *)c)->wheel[i] = states[i];
    return 0;
}

int fmi2GetContinuousStates(void *c, double *states, size_t n)
{
    for (size_t i = 0; i < n; i++) states[i] = ((Crane *)c)->wheel[i];
    return 0;
}

int fmi2GetDerivatives(void *c, double *rates, size_t n)
{
    for (size_t i = 0; i < n; i++) rates[i] = ((Crane *)c)->push[i];
    return ((Crane *)c)->push[0] > 50.0 ? 3 : 0;
}

int fmi2GetNominalsOfContinuousStates(void *c, double *nominals, size_t n)
{
    for (size_t i = 0; i < n; i++) nominals[i] = 1.0;
    return 0;
}

int fmi2GetEventIndicators(void *c, double *indicators, size_t n) { return 0; }

int fmi2GetDirectionalDerivative(void *component, const unsigned *unknowns, size_t n_unknowns, const unsigned *knowns,
                                 size_t n_knowns, const double *seed, double *sensitivity)
{
    const Crane *c = component;
    Crane along = {0};
    for (size_t i = 0; i < n_knowns; i++) *at(&along, knowns[i]) = seed[i];
    double angle = 0, turn = 0;
    for (int i = 0; i < 2; i++) {
        angle += c->wheel[i];
        turn += along.wheel[i];
        along.place[0] += along.arm[i] * cos(angle) - c->arm[i] * sin(angle) * turn;
        along.place[1] += along.arm[i] * sin(angle) + c->arm[i] * cos(angle) * turn;
        along.rate[i] = along.push[i];
    }
    for (size_t i = 0; i < n_unknowns; i++) sensitivity[i] = *at(&along, unknowns[i]);
    return 0;
}

/* What an importer may ask for besides; of these variables the crane has only the gear. */
#define UNUSED(name, type)                                                                \
    int name(void *c, const unsigned *references, size_t n, type values) { return 0; }

UNUSED(fmi2GetInteger, int *)
UNUSED(fmi2GetString, const char **)
