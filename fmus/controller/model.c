#include "model.h"
#include "controller.h"

#include <math.h>
#include <string.h>

/* How far from a sampling instant the importer's time may be, beside rounding [1 of the period]. */
#define SAMPLE_SHARE 1e-6
/* In one step. */
#define MAX_SAMPLES 1e6

static const double start_values[N_VALUES] = START_VALUES;

void model_reset(Model *model, int exchange)
{
    memset(model, 0, sizeof *model);
    memcpy(model->values, start_values, sizeof start_values);
    model->exchange = exchange;
}

void model_start(Model *model) { model->known = 0; }

void model_accept(Model *model) { (void)model; }

const char *model_set(Model *model, size_t index, double value, int starting)
{
    if (!isfinite(value)) return "the value is not finite";
    model->values[index] = value;
    model->touched = 1;
    model->known = 0;
    return NULL;
}

/* When the next sample is due: a period after the one before, so that rounding of the importer's time does not add up. */
static double due(const Model *model) { return model->begun ? model->due : model->time; }

static double tolerance(double time) { return SAMPLE_SHARE * PERIOD + ROUNDING * fabs(time); }

/* There is nothing to begin with before a feature is seen. */
static int waits(const Model *model)
{
    for (size_t i = 0; i < N_FEATURES; i++) {
        if (model->values[OFFSET_SEEN + i] != 0.0) return 0;
    }
    return !model->begun;
}

/* Where the last sample of a step may be. */
static double last_instant(const Model *model, double step)
{
    const double end = model->time + step;
    return end - tolerance(end);
}

const char *model_check(const Model *model, double step)
{
    const int endless = !waits(model) && last_instant(model, step) - due(model) > MAX_SAMPLES * PERIOD;
    return endless ? "the step is longer than a million periods" : NULL;
}

/* Computes x(k+1) and y(k) for the present inputs. */
static void compute(Model *model)
{
    double u[1 + N_SETTABLE], fault = 0.0;
    u[0] = model->begun ? model->first + model->sample * PERIOD : model->time;
    memcpy(u + 1, model->values, N_SETTABLE * sizeof(double));
    memcpy(model->next, model->memory, sizeof model->next);
    if (!model->begun) fault = controller_start(model->next, u, model->answers);
    model->fault = controller_step(model->next, u, model->answers);
    if (fault != 0.0) model->fault = fault;
    model->known = 1;
}

static const char *ensure_known(Model *model)
{
    if (!model->known) compute(model);
    if (model->fault == 0.0) return NULL;
    return model->fault == FAULT_NOT_DEFINITE ? "a covariance is not positive definite"
                                              : "the estimate or the command is not finite";
}

const char *model_get(Model *model, size_t index, double *value)
{
    *value = model->values[index];
    if (index < N_SETTABLE || !model->touched || waits(model)) return NULL;
    if (model->time < due(model) - tolerance(model->time)) return NULL;
    const char *message = ensure_known(model);
    if (message == NULL) *value = model->answers[index - N_SETTABLE];
    return message;
}

static const char *take_sample(Model *model)
{
    const char *message = ensure_known(model);
    if (message != NULL) return message;
    const double now = due(model);
    if (!model->begun) model->first = now;
    model->due = PERIOD + (fabs(model->time - now) <= tolerance(now) ? model->time : now);
    memcpy(model->memory, model->next, sizeof model->memory);
    memcpy(model->values + N_SETTABLE, model->answers, sizeof model->answers);
    model->begun = 1;
    model->sample += 1.0;
    model->known = 0;
    return NULL;
}

const char *model_step(Model *model, double step)
{
    const double end = last_instant(model, step);
    while (due(model) < end && !waits(model)) {
        const char *message = take_sample(model);
        if (message != NULL) return message;
    }
    model->touched = 0; /* earlier inputs are not those of the instant at the end of the step */
    return NULL;
}

const char *model_settle(Model *model, int *changed)
{
    *changed = 0;
    return NULL;
}

int model_next_event(Model *model, char text[MESSAGE_SIZE])
{
    return 0;
}

void model_set_states(Model *model, const double *states)
{
}

const char *model_derive(Model *model, double direction[N_VALUES], int starting)
{
    return "the controller is sampled and has no derivatives";
}
