/* Loads the library of an exported FMU and steps it: drive LIBRARY INPUTS OUTPUTS

   INPUTS holds doubles: the step, the offset and the number of the inputs, then their values in each step. OUTPUTS gets
   all values of the model after each step. FMI_VERSION is 2 or 3; layout.h is that of the FMU. */
#include "layout.h"
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#if FMI_VERSION == 2
#include "fmi2Functions.h"
#define CALL(name) ((fmi2##name##TYPE *)find(library, "fmi2" #name))
#else
#include "fmi3Functions.h"
#define CALL(name) ((fmi3##name##TYPE *)find(library, "fmi3" #name))
#endif

#ifdef _WIN32
#include <windows.h>
static void *load(const char *path) { return (void *)LoadLibraryA(path); }
static void *find(void *library, const char *name) { return (void *)GetProcAddress((HMODULE)library, name); }
#else
#include <dlfcn.h>
static void *load(const char *path) { return dlopen(path, RTLD_NOW | RTLD_LOCAL); }
static void *find(void *library, const char *name) { return dlsym(library, name); }
#endif

static void expect(int good, const char *what)
{
    if (good) return;
    fprintf(stderr, "%s\n", what);
    exit(1);
}

static const struct {
    uint32_t offset;
    uint32_t size;
} groups[] = GROUPS;

/* References of the groups within some values; returns how many. */
static size_t within(size_t first, size_t count, uint32_t *references)
{
    size_t n = 0;
    for (size_t i = 0; i < sizeof groups / sizeof *groups; i++) {
        if (groups[i].offset >= first && groups[i].offset < first + count) references[n++] = groups[i].offset;
    }
    return n;
}

#if FMI_VERSION == 2
static void say(fmi2ComponentEnvironment environment, fmi2String name, fmi2Status status, fmi2String category,
                fmi2String message, ...)
{
    (void)environment, (void)name, (void)status, (void)category;
    fprintf(stderr, "%s\n", message);
}
#else
static void say(fmi3InstanceEnvironment environment, fmi3Status status, fmi3String category, fmi3String message)
{
    (void)environment, (void)status, (void)category;
    fprintf(stderr, "%s\n", message);
}
#endif

int main(int count, char **words)
{
    expect(count == 4, "drive LIBRARY INPUTS OUTPUTS");
    void *library = load(words[1]);
    expect(library != NULL, "the library cannot be loaded");
    FILE *inputs = fopen(words[2], "rb"), *outputs = fopen(words[3], "wb");
    expect(inputs != NULL && outputs != NULL, "a file cannot be opened");
    double head[3], values[N_VALUES], time = 0.0;
    expect(fread(head, sizeof *head, 3, inputs) == 3, "the inputs are cut");
    const double step = head[0];
    const size_t first = (size_t)head[1], n = (size_t)head[2];
    uint32_t to_set[N_VALUES], to_get[N_VALUES];
#if FMI_VERSION == 2
    for (uint32_t i = 0; i < N_VALUES; i++) to_get[i] = i, to_set[i] = (uint32_t)first + i;
    const fmi2CallbackFunctions callbacks = {say, calloc, free, NULL, NULL};
    fmi2Component instance = CALL(Instantiate)("it", fmi2CoSimulation, TOKEN, NULL, &callbacks, 0, 0);
    expect(instance != NULL, "no instance");
    expect(CALL(SetupExperiment)(instance, 0, 0.0, 0.0, 0, 0.0) == fmi2OK, "SetupExperiment");
    expect(CALL(EnterInitializationMode)(instance) == fmi2OK, "EnterInitializationMode");
    expect(CALL(ExitInitializationMode)(instance) == fmi2OK, "ExitInitializationMode");
#else
    const size_t n_get = within(0, N_VALUES, to_get), n_set = within(first, n, to_set);
    fmi3Instance instance = CALL(InstantiateCoSimulation)("it", TOKEN, NULL, 0, 0, 0, 0, NULL, 0, NULL, say, NULL);
    expect(instance != NULL, "no instance");
    expect(CALL(EnterInitializationMode)(instance, 0, 0.0, 0.0, 0, 0.0) == fmi3OK, "EnterInitializationMode");
    expect(CALL(ExitInitializationMode)(instance) == fmi3OK, "ExitInitializationMode");
#endif
    for (size_t k = 0; fread(values, sizeof *values, n, inputs) == n; k++, time = (double)k * step) {
#if FMI_VERSION == 2
        expect(CALL(SetReal)(instance, to_set, n, values) == fmi2OK, "SetReal");
        expect(CALL(DoStep)(instance, time, step, 1) == fmi2OK, "DoStep");
        expect(CALL(GetReal)(instance, to_get, N_VALUES, values) == fmi2OK, "GetReal");
#else
        fmi3Boolean event, terminate, early;
        double last;
        expect(CALL(SetFloat64)(instance, to_set, n_set, values, n) == fmi3OK, "SetFloat64");
        expect(CALL(DoStep)(instance, time, step, 1, &event, &terminate, &early, &last) == fmi3OK, "DoStep");
        expect(CALL(GetFloat64)(instance, to_get, n_get, values, N_VALUES) == fmi3OK, "GetFloat64");
#endif
        expect(fwrite(values, sizeof *values, N_VALUES, outputs) == N_VALUES, "the outputs cannot be written");
    }
    CALL(FreeInstance)(instance);
    return fclose(outputs) == 0 ? 0 : 1;
}
