/* An instance of FMI 3.0, how its functions begin, and its names for `shared_functions.h`. */
#ifndef FMI3_INSTANCE_H
#define FMI3_INSTANCE_H

#include "fmi3Functions.h"
#include "instance.h"

typedef struct {
    Core core;
    unsigned logged; /* bits of categories; errors are always logged */
    fmi3LogMessageCallback log;
    fmi3InstanceEnvironment environment;
} Instance;

typedef fmi3Instance Handle;
typedef fmi3Status Status;
typedef fmi3Boolean Boolean;
typedef fmi3String String;
typedef fmi3Byte Byte;
typedef fmi3FMUState State;

#define FMI(name) fmi3##name
#define FMI_STATE(verb, noun) fmi3##verb##FMUState##noun
#define DESERIALIZE_STATE fmi3DeserializeFMUState
#define GET_DERIVATIVES fmi3GetContinuousStateDerivatives
#define DERIVATIVE_PHASES READABLE
#define STATUS_OK fmi3OK
#define STATUS_ERROR fmi3Error

/* Number of values behind a reference, 0 if there is no such variable. */
size_t size_of(fmi3ValueReference reference);

/* fmi3OK if there is no message, otherwise an error. */
fmi3Status answer(const Instance *instance, const char *function, const char *message);
void report_events(Instance *instance);

#endif
