/* A controller of the crane by its inverse Jacobian, from C that shares nothing with the exported FMUs. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

/* References: 0 and 1 goal, 2 and 3 hook, 4 and 5 angle, 6 and 7 rate, 8 gain; Boolean: 20 and 21 clear. */
typedef struct {
    double reals[9];
    int clear[2];
} Pilot;

static void init(Pilot *p)
{
    memset(p, 0, sizeof *p);
    p->reals[8] = 2.0;
}

void *fmi2Instantiate(const char *name, int type, const char *guid, const char *resources, const void *callbacks,
                      int visible, int logging)
{
    Pilot *p = calloc(1, sizeof *p);
    init(p);
    return p;
}

void fmi2FreeInstance(void *p) { free(p); }

int fmi2Terminate(void *p) { return 0; }

int fmi2SetupExperiment(void *p, int a, double b, double start, int d, double e) { return 0; }

int fmi2EnterInitializationMode(void *p) { return 0; }

int fmi2ExitInitializationMode(void *p) { return 0; }

int fmi2Reset(void *p)
{
    init(p);
    return 0;
}

int fmi2SetReal(void *p, const unsigned *references, size_t n, const double *values)
{
    for (size_t i = 0; i < n; i++) ((Pilot *)p)->reals[references[i]] = values[i];
    return 0;
}

int fmi2GetReal(void *p, const unsigned *references, size_t n, double *values)
{
    for (size_t i = 0; i < n; i++) values[i] = ((Pilot *)p)->reals[references[i]];
    return 0;
}

int fmi2SetBoolean(void *p, const unsigned *references, size_t n, const int *values)
{
    for (size_t i = 0; i < n; i++) ((Pilot *)p)->clear[references[i] - 20] = values[i];
    return 0;
}

int fmi2DoStep(void *component, double time, double h, int unused)
{
    Pilot *p = component;
    const double *goal = p->reals, *hook = p->reals + 2, *angle = p->reals + 4;
    const double a = angle[0], b = angle[0] + angle[1], s = p->clear[0] && p->clear[1] ? p->reals[8] : 0.0;
    const double J[4] = {-0.5 * sin(a) - 0.4 * sin(b), -0.4 * sin(b), 0.5 * cos(a) + 0.4 * cos(b), 0.4 * cos(b)};
    const double determinant = J[0] * J[3] - J[1] * J[2], x = goal[0] - hook[0], y = goal[1] - hook[1];
    p->reals[6] = s * (J[3] * x - J[1] * y) / determinant;
    p->reals[7] = s * (J[0] * y - J[2] * x) / determinant;
    return 0;
}
