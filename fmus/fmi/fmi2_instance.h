/* An instance of FMI 2.0, and how its functions begin. */
#ifndef FMI2_INSTANCE_H
#define FMI2_INSTANCE_H

#include "fmi2Functions.h"
#include "instance.h"

typedef struct {
    Core core;
    unsigned logged; /* bits of categories; errors are always told */
    const fmi2CallbackFunctions *callbacks;
    char *name;
} Instance;

fmi2Status report(const Instance *instance, fmi2Status status, const char *function, const char *message);
/* fmi2OK if there is no message, otherwise an error. */
fmi2Status answer(const Instance *instance, const char *function, const char *message);
void report_events(Instance *instance);

#define OPEN(function, phases)                                                                     \
    Instance *const instance = component;                                                          \
    if (instance == NULL) return fmi2Error;                                                        \
    if ((instance->core.phase & (phases)) == 0) return answer(instance, function, "not allowed in this phase")

#endif
