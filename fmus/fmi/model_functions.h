/* The functions of a model that FMI calls. Its model.h includes this after Model and ModelStatus. */
#ifndef MODEL_FUNCTIONS_H
#define MODEL_FUNCTIONS_H

#ifdef __GNUC__ /* The standard prescribes parameters that a model need not use. */
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif

/* The message of a status; NULL for MODEL_OK. */
const char *model_explain(ModelStatus status);

/* Start values, time 0. */
void model_reset(Model *model, int exchange);
/* Makes the states those that follow from the start values. */
void model_start(Model *model);
/* Whether the values go together. */
ModelStatus model_check(const Model *model);

/* Whether a value may be set now: at the start, by a solver, or else between steps. */
ModelStatus model_admits(size_t index, int starting, int exchanging);
ModelStatus model_set(Model *model, size_t index, double value);
ModelStatus model_get(Model *model, size_t index, double *value);
void model_set_states(Model *model, const double *states);

/* Advances by `step` under the present input. */
ModelStatus model_step(Model *model, double step);
/* Notes that a solver completed a step. */
void model_accept(Model *model);
/* Handles a state event; says whether states changed. */
ModelStatus model_settle(Model *model, int *changed);
/* Writes an event since the last call; zero if there was none (more). */
#define MESSAGE_SIZE 256
int model_next_event(Model *model, char text[MESSAGE_SIZE]);

/* Turns `direction` (N_VALUES, set for parameters, inputs and states) into the derivatives of all values along it.
   `starting`: the states still follow the start values. */
ModelStatus model_derive(Model *model, double direction[N_VALUES], int starting);

#endif
