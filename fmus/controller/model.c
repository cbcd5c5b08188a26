#include "model.h"
#include "controller.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* How far from a sampling instant the importer's time may be [1 of the period]. */
#define SAMPLE_SHARE 1e-6
/* In one step. */
#define MAX_SAMPLES 1e6

static const double start_values[N_VALUES] = START_VALUES;

const char *model_explain(ModelStatus status)
{
    switch (status) {
    case MODEL_NO_SUCH_VARIABLE: return "there is no variable with this value reference";
    case MODEL_NOT_SETTABLE: return "this variable is computed by the model and cannot be set";
    case MODEL_BAD_VALUE: return "the value is not finite";
    case MODEL_NO_DERIVATIVES: return "the controller is sampled and has no derivatives";
    case MODEL_TOO_LONG: return "the step is longer than a million periods";
    case MODEL_NOT_FINITE: return "the estimate or the command is not finite";
    case MODEL_NOT_DEFINITE: return "a covariance is not positive definite";
    case MODEL_NO_MEMORY: return "out of memory";
    default: return NULL;
    }
}

void model_reset(Model *model, int exchange)
{
    memset(model, 0, sizeof *model);
    memcpy(model->values, start_values, sizeof start_values);
    model->exchange = exchange;
}

void model_start(Model *model) { model->known = 0; }

void model_accept(Model *model) { (void)model; }

ModelStatus model_check(const Model *model)
{
    return MODEL_OK;
}

ModelStatus model_admits(size_t index, int starting, int exchanging)
{
    return MODEL_OK;
}

ModelStatus model_set(Model *model, size_t index, double value)
{
    if (index >= N_VALUES) return MODEL_NO_SUCH_VARIABLE;
    if (index >= N_SETTABLE) return MODEL_NOT_SETTABLE;
    if (!isfinite(value)) return MODEL_BAD_VALUE;
    model->values[index] = value;
    model->touched = 1;
    model->known = 0;
    return MODEL_OK;
}

static double instant(const Model *model) { return model->begun ? model->first + model->sample * PERIOD : model->time; }

/* There is nothing to begin with before a feature is seen. */
static int waits(const Model *model)
{
    for (size_t i = 0; i < N_FEATURES; i++) {
        if (model->values[OFFSET_SEEN + i] != 0.0) return 0;
    }
    return !model->begun;
}

/* Computes x(k+1) and y(k) for the present inputs; `scratch` has room for all of it. */
static void compute(Model *model, double *scratch)
{
    double *u = scratch, *first = u + 1 + N_SETTABLE, *w = first + N_MEMORY, fault = 0.0;
    const double *arguments[N_POINTERS];
    double *results[N_POINTERS];
    int iw[N_WHOLE_WORK];
    u[0] = instant(model);
    memcpy(u + 1, model->values, N_SETTABLE * sizeof(double));
    model->fault = 0.0;
    const double *memory = model->memory;
    if (!model->begun) {
        arguments[0] = u;
        results[0] = first;
        results[1] = &fault;
        controller_start(arguments, results, iw, w, 0);
        memory = first;
    }
    arguments[0] = memory;
    arguments[1] = u;
    results[0] = model->next;
    results[1] = model->answers;
    results[2] = &model->fault;
    controller_step(arguments, results, iw, w, 0);
    if (fault != 0.0) model->fault = fault;
    model->known = 1;
}

static ModelStatus ensure_known(Model *model)
{
    if (!model->known) {
        double *scratch = malloc((1 + N_SETTABLE + N_MEMORY + N_WORK) * sizeof *scratch);
        if (scratch == NULL) return MODEL_NO_MEMORY;
        compute(model, scratch);
        free(scratch);
    }
    if (model->fault == 0.0) return MODEL_OK;
    return model->fault == FAULT_NOT_DEFINITE ? MODEL_NOT_DEFINITE : MODEL_NOT_FINITE;
}

ModelStatus model_get(Model *model, size_t index, double *value)
{
    if (index >= N_VALUES) return MODEL_NO_SUCH_VARIABLE;
    *value = model->values[index];
    if (index < N_SETTABLE || !model->touched || waits(model)) return MODEL_OK;
    if (model->time < instant(model) - SAMPLE_SHARE * PERIOD) return MODEL_OK;
    const ModelStatus status = ensure_known(model);
    if (status == MODEL_OK) *value = model->answers[index - N_SETTABLE];
    return status;
}

static ModelStatus take_sample(Model *model)
{
    const ModelStatus status = ensure_known(model);
    if (status != MODEL_OK) return status;
    if (!model->begun) model->first = model->time;
    memcpy(model->memory, model->next, sizeof model->memory);
    memcpy(model->values + N_SETTABLE, model->answers, sizeof model->answers);
    model->begun = 1;
    model->sample += 1.0;
    model->known = 0;
    return MODEL_OK;
}

ModelStatus model_step(Model *model, double step)
{
    const double end = model->time + step - SAMPLE_SHARE * PERIOD;
    if (!waits(model) && end - instant(model) > MAX_SAMPLES * PERIOD) return MODEL_TOO_LONG;
    while (instant(model) < end && !waits(model)) {
        const ModelStatus status = take_sample(model);
        if (status != MODEL_OK) return status;
    }
    model->touched = 0; /* earlier inputs are not those of the instant at the end of the step */
    return MODEL_OK;
}

ModelStatus model_settle(Model *model, int *changed)
{
    *changed = 0;
    return MODEL_OK;
}

int model_next_event(Model *model, char text[MESSAGE_SIZE])
{
    return 0;
}

void model_set_states(Model *model, const double *states)
{
}

ModelStatus model_derive(Model *model, double direction[N_VALUES], int starting)
{
    return MODEL_NO_DERIVATIVES;
}
