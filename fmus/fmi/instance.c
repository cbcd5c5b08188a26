#include "instance.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* How far the importer's time may be from the model's own, beside rounding: a share of the step. */
#define STEP_SHARE 1e-6
/* How far a solver's last point may be behind the stop time [s]. */
#define STOP_SLACK 1e-9

const char *const log_categories[N_CATEGORIES] = {"logStatusError", "logStatusWarning", "logEvents"};

void core_reset(Core *core, int exchange)
{
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
    const char *message = model_check(&core->model, 0.0);
    if (message == NULL) core->phase = core->model.exchange ? IN_EVENT : STEPPING;
    return message;
}

const char *core_step(Core *core, double time, double step)
{
    Model *model = &core->model;
    if (!isfinite(step) || step < 0.0) return "the step size is negative or not finite";
    const double tolerance = STEP_SHARE * step + ROUNDING * fabs(time);
    if (!(fabs(time - model->time) <= tolerance)) return "the communication point is not where the last step ended";
    if (time + step > core->stop_time + tolerance) return "the step ends after the stop time";
    if (step > 0.0) {
        const char *message = model_check(model, step);
        if (message != NULL) return message;
        message = model_step(model, step);
        if (message != NULL) core->phase = FAILED;
        if (message != NULL) return message;
    }
    model->time = time + step;
    return NULL;
}

const char *core_check_stop_time(const Core *core)
{
    const double time = core->model.time, slack = STOP_SLACK + ROUNDING * fabs(time);
    return time <= core->stop_time + slack ? NULL : "the time is after the stop time";
}

#define NO_SUCH_VARIABLE "there is no variable with this value reference"

/* Whether variables exist, begin below `end` and have as many values as there is room for. */
static const char *check(Variables variables, size_t end, const char *missing)
{
    size_t k = 0;
    for (size_t i = 0; i < variables.count; i++) {
        const size_t size = size_of(variables.references[i]);
        if (size == 0 || variables.references[i] >= end) return missing;
        k += size;
    }
    if (k < variables.n_values) return "too many values for these variables";
    return k > variables.n_values ? "too few values for these variables" : NULL;
}

static const char *get_value(Core *core, size_t index, double *value)
{
    if (index < N_VALUES) return model_get(&core->model, index, value);
    *value = core->model.time; /* the independent variable of FMI 3 */
    return NULL;
}

const char *core_get(Core *core, Variables variables, double values[])
{
    const char *message = check(variables, N_VALUES + 1, NO_SUCH_VARIABLE);
    for (size_t i = 0; message == NULL && i < variables.count; i++) {
        const size_t first = variables.references[i], end = first + size_of(first);
        for (size_t j = first; message == NULL && j < end; j++) message = get_value(core, j, values++);
    }
    return message;
}

static const char *set_value(Core *core, size_t index, double value)
{
    /* The states come last; solvers that know no other way may set them one by one. */
    const size_t end = core->phase & EXCHANGING ? N_SETTABLE : N_SETTABLE - N_STATES;
    if (index >= end) return "this variable is computed by the model and cannot be set";
    return model_set(&core->model, index, value, (core->phase & STARTING) != 0);
}

const char *core_set(Core *core, Variables variables, const double values[])
{
    const char *message = check(variables, N_VALUES, NO_SUCH_VARIABLE); /* not the time */
    for (size_t i = 0; message == NULL && i < variables.count; i++) {
        const size_t first = variables.references[i], end = first + size_of(first);
        for (size_t j = first; message == NULL && j < end; j++) message = set_value(core, j, *values++);
    }
    if (core->phase & STARTING) model_start(&core->model);
    return message;
}

const char *core_derive(Core *core, Variables unknowns, Variables knowns, const double seed[], double product[])
{
    double direction[N_VALUES] = {0.0};
    const char *message = check(knowns, N_SETTABLE, "this is no known");
    if (message == NULL) message = check(unknowns, N_VALUES, "this is no unknown");
    for (size_t i = 0; message == NULL && i < knowns.count; seed += size_of(knowns.references[i++])) {
        memcpy(direction + knowns.references[i], seed, size_of(knowns.references[i]) * sizeof(double));
    }
    if (message == NULL) message = model_derive(&core->model, direction, core->phase == INITIALISING);
    for (size_t i = 0; message == NULL && i < unknowns.count; product += size_of(unknowns.references[i++])) {
        memcpy(product, direction + unknowns.references[i], size_of(unknowns.references[i]) * sizeof(double));
    }
    return message;
}

/* The sum of the unknowns along a direction, each times its seed. */
static double weighed(const double direction[N_VALUES], Variables unknowns, const double seed[])
{
    double sum = 0.0;
    for (size_t i = 0; i < unknowns.count; i++) {
        const unsigned first = unknowns.references[i];
        for (size_t j = 0; j < size_of(first); j++) sum += *seed++ * direction[first + j];
    }
    return sum;
}

/* From one direction for each known: the model has some hundred values, and no tape. */
const char *core_derive_adjoint(Core *core, Variables unknowns, Variables knowns, const double seed[], double product[])
{
    const char *message = check(knowns, N_SETTABLE, "this is no known");
    if (message == NULL) message = check(unknowns, N_VALUES, "this is no unknown");
    for (size_t i = 0; message == NULL && i < knowns.count; i++) {
        const unsigned first = knowns.references[i];
        for (size_t j = 0; message == NULL && j < size_of(first); j++) {
            double direction[N_VALUES] = {0.0};
            direction[first + j] = 1.0;
            message = model_derive(&core->model, direction, core->phase == INITIALISING);
            if (message == NULL) *product++ = weighed(direction, unknowns, seed);
        }
    }
    return message;
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
