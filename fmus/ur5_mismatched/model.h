/* The arm as a dynamic system, free of FMI: one flat vector of values, a step, derivatives and their sensitivities.

   dq/dt = v,   dv/dt = (clip(u) - v) / lag;   y = ball in the camera frame at q */
#ifndef MODEL_H
#define MODEL_H

#include "layout.h"
#include <stddef.h>

typedef struct {
    double time;
    double values[N_VALUES];
    double gain_step;            /* communication step that the gains below hold for; negative: none */
    double drift[N_JOINTS];      /* q+ = q + drift v + push u */
    double push[N_JOINTS];
    double decay[N_JOINTS];      /* v+ = decay v + (1 - decay) u */
    int stale;                   /* which computed values are out of date */
} Model;

typedef enum { MODEL_OK, MODEL_NO_SUCH_VARIABLE, MODEL_NOT_SETTABLE, MODEL_BAD_VALUE } ModelStatus;

/* Start values, at home, time 0. */
void model_reset(Model *model);
/* Places the joints at home, at rest. */
void model_start(Model *model);
/* Non-zero if a joint's lower stop is not below its upper one. */
int model_has_empty_range(const Model *model);

ModelStatus model_set(Model *model, size_t index, double value);
ModelStatus model_get(Model *model, size_t index, double *value);
/* Positions, then velocities. */
void model_set_states(Model *model, const double *states);

/* Advances by `step` under the present input, exactly; non-zero if the result is not finite. */
int model_step(Model *model, double step);

/* Turns `direction` (N_VALUES, set for parameters, inputs and states) into the derivatives of all values along it.
   `starting`: the states still follow the home position. */
void model_derive(const Model *model, double direction[N_VALUES], int starting);

#endif
