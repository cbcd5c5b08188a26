#include "instance.h"

#include <float.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* How far the importer's time may be from the model's own: a share of the step, and rounding of the time itself. */
#define STEP_SHARE 1e-6
#define ROUNDING (8.0 * DBL_EPSILON)
/* How far a solver's last point may be behind the stop time [s]. */
#define STOP_SLACK 1e-9

const char *const log_categories[N_CATEGORIES] = {"logStatusError", "logStatusWarning", "logEvents"};

static double time_tolerance(double time, double step) { return STEP_SHARE * step + ROUNDING * fabs(time); }

void core_reset(Core *core, int exchange)
{
    memset(core, 0, sizeof *core);
    model_reset(&core->model, exchange);
    core->stop_time = HUGE_VAL;
    core->phase = INSTANTIATED;
}

const char *core_begin(Core *core, double start, int stop_defined, double stop)
{
    if (!isfinite(start)) return "the start time is not finite";
    if (stop_defined && !(stop >= start)) return "the stop time is before the start time";
    core->model.time = start;
    core->stop_time = stop_defined ? stop : HUGE_VAL;
    return NULL;
}

const char *core_leave_initialisation(Core *core)
{
    const ModelStatus status = model_check(&core->model);
    if (status == MODEL_OK) core->phase = core->model.exchange ? IN_EVENT : STEPPING;
    return model_explain(status);
}

const char *core_get(Core *core, size_t index, double *value)
{
    return model_explain(model_get(&core->model, index, value));
}

const char *core_set(Core *core, size_t index, double value)
{
    const int starting = (core->phase & (INSTANTIATED | INITIALISING)) != 0;
    const ModelStatus status = model_admits(index, starting, (core->phase & EXCHANGING) != 0);
    return model_explain(status == MODEL_OK ? model_set(&core->model, index, value) : status);
}

const char *core_step(Core *core, double time, double step)
{
    Model *model = &core->model;
    if (!isfinite(step) || step < 0.0) return "the step size is negative or not finite";
    const double tolerance = time_tolerance(time, step);
    if (!(fabs(time - model->time) <= tolerance)) return "the communication point is not where the last step ended";
    if (time + step > core->stop_time + tolerance) return "the step ends after the stop time";
    if (step > 0.0) {
        const ModelStatus status = model_step(model, step);
        if (status >= MODEL_NOT_FINITE) core->phase = FAILED;
        if (status != MODEL_OK) return model_explain(status);
    }
    model->time = time + step;
    return NULL;
}

const char *core_check_stop_time(const Core *core)
{
    const double time = core->model.time, slack = STOP_SLACK + ROUNDING * fabs(time);
    return time <= core->stop_time + slack ? NULL : "the time is after the stop time";
}

const char *core_update_discrete_states(Core *core, int *states_changed)
{
    return model_explain(model_settle(&core->model, states_changed));
}

/* FNV-1a */
static unsigned long long checksum_of(const Core *core)
{
    const unsigned char *bytes = (const unsigned char *)core;
    unsigned long long sum = 14695981039346656037ULL;
    for (size_t i = 0; i < sizeof *core; i++) sum = (sum ^ bytes[i]) * 1099511628211ULL;
    return sum;
}

Snapshot *snapshot_take(const Core *core)
{
    Snapshot *snapshot = calloc(1, sizeof *snapshot);
    if (snapshot == NULL) return NULL;
    strncpy(snapshot->token, TOKEN, sizeof snapshot->token - 1);
    memcpy(&snapshot->core, core, sizeof *core);
    snapshot->checksum = checksum_of(&snapshot->core);
    return snapshot;
}

Snapshot *snapshot_read(const void *bytes, size_t size)
{
    Snapshot *snapshot = size == sizeof *snapshot ? malloc(size) : NULL;
    if (snapshot == NULL) return NULL;
    memcpy(snapshot, bytes, size);
    if (memcmp(snapshot->token, TOKEN, sizeof TOKEN) != 0 || snapshot->checksum != checksum_of(&snapshot->core)) {
        free(snapshot);
        return NULL;
    }
    return snapshot;
}

const char *core_restore(Core *core, const Snapshot *snapshot)
{
    if (snapshot == NULL) return "there is no state";
    if (snapshot->core.model.exchange != core->model.exchange) {
        return "this state was saved in the other of model exchange and co-simulation";
    }
    memcpy(core, &snapshot->core, sizeof *core);
    return NULL;
}

void compose(char text[MESSAGE_SIZE], const char *function, const char *message)
{
    (void)snprintf(text, MESSAGE_SIZE, "%s: %s", function, message);
}

unsigned category_bits(size_t count, const char *const categories[])
{
    unsigned bits = count == 0 ? LOG_ALL : 0;
    for (size_t i = 0; i < count; i++) {
        unsigned bit = 0;
        for (unsigned k = 0; k < N_CATEGORIES; k++) {
            if (categories[i] != NULL && strcmp(categories[i], log_categories[k]) == 0) bit = 1U << k;
        }
        if (bit == 0) return 0;
        bits |= bit;
    }
    return bits;
}
