/* An instance of FMI 3.0, and how its functions begin. */
#ifndef FMI3_INSTANCE_H
#define FMI3_INSTANCE_H

#include "fmi3Functions.h"
#include "instance.h"

typedef struct {
    Core core;
    unsigned logged; /* bits of categories; errors are always told */
    fmi3LogMessageCallback log;
    fmi3InstanceEnvironment environment;
} Instance;

/* fmi3OK if there is no message, otherwise an error. */
fmi3Status answer(const Instance *instance, const char *function, const char *message);
void report_events(Instance *instance);
/* Number of values behind a reference, 0 if there is no such variable. */
size_t size_of(fmi3ValueReference reference);

#define OPEN(function, phases)                                                                    \
    Instance *const self = instance;                                                              \
    if (self == NULL) return fmi3Error;                                                           \
    if ((self->core.phase & (phases)) == 0) return answer(self, function, "not allowed in this phase")

#endif
