/* The arm as a dynamic system, free of FMI: one flat vector of values, a step, derivatives and their sensitivities.

   dq/dt = v,   dv/dt = (clip(u) - v) / lag;   y = features at q, such as the ball in the camera frame

   A joint that meets a stop rests there, v = 0, for as long as u drives it into the stop. */
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
    int exchange;                /* a solver integrates the model: joints are held and freed at events only */
    int held[N_JOINTS];          /* 1 by its upper stop, -1 by its lower one, 0 free */
    int stale;                   /* which computed values are out of date */
} Model;

typedef enum {
    MODEL_OK,
    MODEL_NO_SUCH_VARIABLE,
    MODEL_NOT_SETTABLE,
    MODEL_FIXED,
    MODEL_BAD_VALUE,
    MODEL_EMPTY_RANGE,
    MODEL_BEYOND_STOP,
    MODEL_NOT_FINITE
} ModelStatus;

/* Start values, at home, time 0. */
void model_reset(Model *model, int exchange);
/* Places the joints at home, at rest. */
void model_start(Model *model);
/* Non-zero if a joint's lower stop is not below its upper one. */
int model_has_empty_range(const Model *model);
/* Whether every joint has a range and is within it. */
ModelStatus model_check_range(const Model *model);

ModelStatus model_set(Model *model, size_t index, double value);
ModelStatus model_get(Model *model, size_t index, double *value);
/* Positions, then velocities. */
void model_set_states(Model *model, const double *states);

/* Advances by `step` under the present input, exactly; stops act at its end. Without a range nothing changes. */
ModelStatus model_step(Model *model, double step);
/* Brings to rest the joints that have met a stop, and frees those that are driven away; non-zero if states changed. */
int model_settle(Model *model);
/* Finds out which joints are held, unless only events tell. */
void model_hold(Model *model);

/* Turns `direction` (N_VALUES, set for parameters, inputs and states) into the derivatives of all values along it.
   `starting`: the states still follow the home position. */
void model_derive(Model *model, double direction[N_VALUES], int starting);

#endif
