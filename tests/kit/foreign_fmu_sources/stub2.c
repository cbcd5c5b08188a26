/* FMI 2: a planar arm of two joints that follow a speed, and its tip; each macro is a fault or a habit of an FMU. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

typedef void (*Log)(void *, const char *, int, const char *, const char *, ...);

typedef struct {
    Log log;
    void *allocate, *release, *finished, *environment;
} Callbacks;

typedef struct {
    double time, joint[2], speed[2], tip[2];
    int steps;
} Stub;

static const Callbacks *callbacks;

static void hang(void)
{
    for (;;) pause();
}

#ifdef AT_UNLOAD
__attribute__((destructor)) static void unload(void)
{
    if (getenv("STUB_MAY_FALL")) AT_UNLOAD;
}
#endif

static void look(Stub *s)
{
    s->tip[0] = 0.5 * cos(s->joint[0]) + 0.4 * cos(s->joint[0] + s->joint[1]);
    s->tip[1] = 0.5 * sin(s->joint[0]) + 0.4 * sin(s->joint[0] + s->joint[1]);
#ifdef HEIGHT
    s->tip[1] = HEIGHT;
#endif
#ifdef MOVES_BEFORE
    if (s->time < MOVES_BEFORE) s->tip[1] += 0.05;
#endif
}

static void init(Stub *s)
{
    memset(s, 0, sizeof *s);
    s->joint[0] = 0.3;
    s->joint[1] = 1.2;
}

void *fmi2Instantiate(const char *name, int type, const char *guid, const char *resources, const Callbacks *given,
                      int visible, int logging)
{
    Stub *s = calloc(1, sizeof *s);
    callbacks = given;
    init(s);
#ifdef OPENS
    char file[5000];
    snprintf(file, sizeof file, "%s/%s", resources + (strncmp(resources, "file://", 7) ? 0 : 7), OPENS);
    FILE *found = fopen(file, "r");
    if (!found) {
        given->log(given->environment, name, 3, "error", "cannot open %s", file);
        return 0;
    }
    fclose(found);
#endif
    return s;
}

int fmi2SetupExperiment(void *s, int a, double b, double start, int c, double d)
{
    ((Stub *)s)->time = start;
    return 0;
}

int fmi2EnterInitializationMode(void *s) { return 0; }

int fmi2ExitInitializationMode(void *s)
{
#ifndef LOOKS_AFTER
    look(s);
#endif
    return 0;
}

#ifndef NO_RESET
int fmi2Reset(void *s)
{
    init(s);
    return 0;
}
#endif

int fmi2Terminate(void *s)
{
#ifdef AT_TERMINATE
    AT_TERMINATE;
#endif
    return 0;
}

#ifndef NO_FREE
void fmi2FreeInstance(void *s)
{
#ifdef AT_FREE
    AT_FREE;
#endif
    free(s);
}
#endif

static double *at(Stub *s, unsigned reference)
{
    double *groups[] = {s->joint, s->speed, s->tip};
    return groups[reference / 10 - 1] + reference % 10;
}

int fmi2SetReal(void *s, const unsigned *references, size_t n, const double *values)
{
    for (size_t i = 0; i < n; i++) *at(s, references[i]) = values[i];
    return 0;
}

int fmi2GetReal(void *s, const unsigned *references, size_t n, double *values)
{
    for (size_t i = 0; i < n; i++) values[i] = *at(s, references[i]);
    return 0;
}

#ifdef ENDS_EARLY
#ifdef HAS_STATUS
int fmi2GetRealStatus(void *s, int kind, double *value) { return 2; }
#endif
#endif

int fmi2DoStep(void *component, double time, double step, int unused)
{
    Stub *s = component;
#ifdef ENDS_EARLY
    if (time > ENDS_EARLY) {
        callbacks->log(callbacks->environment, "stub", 2, "all", "step too long");
        return 2;
    }
#endif
#ifdef FALLS_AFTER
    if (time > FALLS_AFTER) abort();
#endif
    for (int i = 0; i < 2; i++) s->joint[i] += step * s->speed[i];
    s->time = time + step;
    s->steps++;
#ifdef LOOKS_AFTER
    if (s->steps > LOOKS_AFTER)
#endif
        look(s);
    return 0;
}
