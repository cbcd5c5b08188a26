/* An instance of FMI 2.0, how its functions begin, and its names for `shared_functions.h`. */
#ifndef FMI2_INSTANCE_H
#define FMI2_INSTANCE_H

#include "fmi2Functions.h"
#include "instance.h"

typedef struct {
    Core core;
    unsigned logged; /* bits of categories; errors are always logged */
    const fmi2CallbackFunctions *callbacks;
    char *name;
} Instance;

typedef fmi2Component Handle;
typedef fmi2Status Status;
typedef fmi2Boolean Boolean;
typedef fmi2String String;
typedef fmi2Byte Byte;
typedef fmi2FMUstate State;

#define FMI(name) fmi2##name
#define FMI_STATE(verb, noun) fmi2##verb##FMUstate##noun
#define DESERIALIZE_STATE fmi2DeSerializeFMUstate
#define GET_DERIVATIVES fmi2GetDerivatives
#define DERIVATIVE_PHASES (RUNNING | TERMINATED)
#define STATUS_OK fmi2OK
#define STATUS_ERROR fmi2Error

fmi2Status report(const Instance *instance, fmi2Status status, const char *function, const char *message);

/* fmi2OK if there is no message, otherwise an error. */
fmi2Status answer(const Instance *instance, const char *function, const char *message);
void report_events(Instance *instance);

#endif
