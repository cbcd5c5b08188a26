/* A controller as a system in discrete time, free of FMI: one flat vector of values, and a sample each period.

   u(k) = [time, inputs],   x(0) = start(u(0)),   x(k+1), y(k) = step(x(k), u(k))

   The first sample is taken when a feature is seen. At a sampling instant the outputs follow the inputs as soon as one is
   set; until then, and between the instants, they are those of the last sample. A step makes the samples of the instants
   from its beginning on and before its end. There are no events, no continuous states and no derivatives. */
#ifndef MODEL_H
#define MODEL_H

#include "layout.h"
#include <stddef.h>

enum { HAS_EXCHANGE = 0, N_STATES = 0, N_INDICATORS = 0 };
enum { OFFSET_STATES = 0, OFFSET_DERIVATIVES = 0, OFFSET_INDICATORS = 0 };

typedef struct {
    double time;
    int exchange;
    double values[N_VALUES];    /* inputs, then outputs of the last sample */
    double first;               /* time of the first sample */
    double due;                 /* when the importer's time reaches the next one */
    double sample;              /* k, a whole number */
    int begun;                  /* there is a state */
    int touched;                /* an input was set after the last step */
    int known;                  /* the next three are those of the present inputs */
    double fault;               /* of the step, as the generated code numbers them */
    double next[N_MEMORY];      /* x(k+1) */
    double answers[N_ANSWERS];  /* y(k) */
    double memory[N_MEMORY];    /* x(k) */
} Model;

#include "model_functions.h"

#endif
