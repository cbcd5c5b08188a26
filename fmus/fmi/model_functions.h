/* The functions of a model that FMI calls. Its model.h includes this after Model.

   A function that returns text returns NULL where all is well, and otherwise a message for the user. */
#ifndef MODEL_FUNCTIONS_H
#define MODEL_FUNCTIONS_H

#include <float.h>

#ifdef __GNUC__ /* The standard prescribes parameters that a model need not use. */
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif

/* How far two times may be apart by rounding alone [1 of the time]. */
#define ROUNDING (8.0 * DBL_EPSILON)

/* Start values, time 0. */
void model_reset(Model *model, int exchange);
/* Makes the states those that follow from the start values. */
void model_start(Model *model);
/* Whether the values go together and a step of this length can be made. */
const char *model_check(const Model *model, double step);

/* Sets a parameter, an input or a state; `starting`: before the end of initialisation. */
const char *model_set(Model *model, size_t index, double value, int starting);
const char *model_get(Model *model, size_t index, double *value);
void model_set_states(Model *model, const double *states);

/* Advances by `step` under the present input, after `model_check`; a message ends the run. */
const char *model_step(Model *model, double step);
/* Notes that a solver completed a step. */
void model_accept(Model *model);
/* Handles a state event; says whether states changed. */
const char *model_settle(Model *model, int *changed);
/* Writes an event since the last call; zero if there was none (more). */
#define MESSAGE_SIZE 256
int model_next_event(Model *model, char text[MESSAGE_SIZE]);

/* Turns `direction` (N_VALUES, set for parameters, inputs and states) into the derivatives of all values along it.
   `starting`: the states still follow the start values. */
const char *model_derive(Model *model, double direction[N_VALUES], int starting);

#endif
