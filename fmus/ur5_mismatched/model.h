/* The arm as a dynamic system, free of FMI: one flat vector of values, a step, derivatives and their sensitivities.

   dq/dt = v,   dv/dt = (clip(u) - v) / lag;   y = features at q, such as the ball in the camera frame

   A joint that meets a stop rests there, v = 0, for as long as u drives it into the stop. */
#ifndef MODEL_H
#define MODEL_H

#include "layout.h"
#include <stddef.h>

/* Positions and velocities; as many event indicators. */
enum {
    HAS_EXCHANGE = 1,
    N_STATES = 2 * N_JOINTS,
    OFFSET_STATES = OFFSET_JOINT_POSITION,
    OFFSET_DERIVATIVES = OFFSET_DER_JOINT_POSITION,
    OFFSET_INDICATORS = OFFSET_STOP_INDICATOR
};

typedef struct {
    double time;
    double values[N_VALUES];
    double gain_step;            /* communication step that the gains below hold for; negative: none */
    double drift[N_JOINTS];      /* q+ = q + drift v + push u */
    double push[N_JOINTS];
    double decay[N_JOINTS];      /* v+ = decay v + (1 - decay) u */
    int exchange;                /* a solver integrates the model: joints are held and freed at events only */
    int held[N_JOINTS];          /* 1 by its upper stop, -1 by its lower one, 0 free */
    int reported[N_JOINTS];      /* what the log knows of `held` */
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
    MODEL_NOT_FINITE /* this and what follows ends a run */
} ModelStatus;

/* What a status says to the user; NULL for MODEL_OK. */
const char *model_explain(ModelStatus status);

/* Start values, at home, time 0. */
void model_reset(Model *model, int exchange);
/* Places the joints at home, at rest. */
void model_start(Model *model);
/* Whether every joint has a range and is within it. */
ModelStatus model_check(const Model *model);

/* Whether a value may be set now: at the start, by a solver, or else between steps. */
ModelStatus model_admits(size_t index, int starting, int exchanging);
ModelStatus model_set(Model *model, size_t index, double value);
ModelStatus model_get(Model *model, size_t index, double *value);
/* Positions, then velocities. */
void model_set_states(Model *model, const double *states);

/* Advances by `step` under the present input, exactly; stops act at its end. Without a range nothing changes. */
ModelStatus model_step(Model *model, double step);
/* Brings to rest the joints that have met a stop, and frees those that are driven away; says whether states changed. */
ModelStatus model_settle(Model *model, int *changed);
/* Writes what happened at a stop since the last call; zero if nothing (more) did. */
#define MESSAGE_SIZE 256
int model_next_event(Model *model, char text[MESSAGE_SIZE]);

/* Turns `direction` (N_VALUES, set for parameters, inputs and states) into the derivatives of all values along it.
   `starting`: the states still follow the home position. */
ModelStatus model_derive(Model *model, double direction[N_VALUES], int starting);

#endif
