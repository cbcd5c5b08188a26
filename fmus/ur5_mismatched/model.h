/* The arm as a dynamic system, free of FMI: one flat vector of values, a step, derivatives and their sensitivities.

   dq/dt = v,   dv/dt = (clip(u) - v) / lag;   y = features at q, such as the ball in the camera frame

   A joint that meets a stop rests there, v = 0, for as long as u drives it into the stop. At the start it is at home, at
   rest. A step is exact and stops act at its end; the states are positions and velocities, then those of the tool.
   Behind its gear a joint is driven through play, whose memory changes at the end of a step only. */
#ifndef MODEL_H
#define MODEL_H

#include "layout.h"
#include <stddef.h>

enum {
    HAS_EXCHANGE = 1,
    N_STATES = 2 * N_JOINTS + 6,
    N_INDICATORS = 2 * N_JOINTS,
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
    double driven[N_JOINTS];     /* joints behind their gears at the end of the last step */
    int exchange;                /* a solver integrates the model: joints are held and freed at events only */
    int held[N_JOINTS];          /* 1 by its upper stop, -1 by its lower one, 0 free */
    int reported[N_JOINTS];      /* values of `held` in the last log messages */
    int flexible;                /* whether the tool was, at the last step or event */
    int stale;                   /* which computed values are out of date */
} Model;

#include "model_functions.h"

#endif
