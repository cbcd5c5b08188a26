#include "model.h"
#include "kinematics.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

/* In continuous time a lag of zero would make the equations algebraic; below this it counts as this. */
#define MIN_LAG 1e-6
/* How far behind its stop a joint meets it [rad]; a joint that leaves a stop does not meet it at once that way. */
#define STOP_HYSTERESIS 1e-9

enum { STALE_FEATURE = 1, STALE_JACOBIAN = 2, STALE_DERIVATIVES = 4, STALE_ALL = 7 };

static const double start_values[N_VALUES] = START_VALUES;
static const double minima[N_SETTABLE] = MINIMA;

static double clip(double value, double lower, double upper)
{
    return value < lower ? lower : value > upper ? upper : value;
}

/* The joint position in whole steps of its encoder; ties go to even numbers of steps. */
static double encoder_position(const Model *model, size_t i)
{
    const double q = model->values[OFFSET_JOINT_POSITION + i], step = model->values[OFFSET_ENCODER_RESOLUTION + i];
    return step > 0.0 ? rint(q / step) * step : q;
}

static double clipped_command(const Model *model, size_t i)
{
    const double limit = model->values[OFFSET_MAX_SPEED + i];
    return clip(model->values[OFFSET_JOINT_VELOCITY_COMMAND + i], -limit, limit);
}

static double continuous_lag(const Model *model, size_t i)
{
    return fmax(model->values[OFFSET_LAG + i], MIN_LAG);
}

static double upper_room(const Model *model, size_t i)
{
    return model->values[OFFSET_JOINT_UPPER + i] - model->values[OFFSET_JOINT_POSITION + i];
}

static double lower_room(const Model *model, size_t i)
{
    return model->values[OFFSET_JOINT_POSITION + i] - model->values[OFFSET_JOINT_LOWER + i];
}

/* 1 if a joint at or behind its upper stop moves on by its velocity, or at rest by its command; -1 for the lower one. */
static int side_met(const Model *model, size_t i)
{
    const double v = model->values[OFFSET_JOINT_VELOCITY + i], along = v != 0.0 ? v : clipped_command(model, i);
    return along > 0.0 && upper_room(model, i) <= 0.0 ? 1 : along < 0.0 && lower_room(model, i) <= 0.0 ? -1 : 0;
}

static int is_driven(const Model *model, size_t i, int side) { return clipped_command(model, i) * side > 0.0; }

const char *model_explain(ModelStatus status)
{
    switch (status) {
    case MODEL_NO_SUCH_VARIABLE: return "there is no variable with this value reference";
    case MODEL_NOT_SETTABLE: return "this variable is computed by the model and cannot be set";
    case MODEL_FIXED: return "this parameter is fixed: it can be set before the end of initialisation only";
    case MODEL_BAD_VALUE: return "the value is not finite or below the variable's minimum";
    case MODEL_EMPTY_RANGE: return "joint_lower is not below joint_upper";
    case MODEL_BEYOND_STOP: return "a joint is beyond its stops joint_lower and joint_upper";
    case MODEL_NOT_FINITE: return "a joint position is not finite";
    default: return NULL;
    }
}

void model_reset(Model *model, int exchange)
{
    memset(model, 0, sizeof *model);
    memcpy(model->values, start_values, sizeof start_values);
    model->gain_step = -1.0;
    model->exchange = exchange;
    model_start(model);
}

void model_start(Model *model)
{
    for (size_t i = 0; i < N_JOINTS; i++) {
        model->values[OFFSET_JOINT_POSITION + i] = model->values[OFFSET_HOME + i];
        model->values[OFFSET_JOINT_VELOCITY + i] = 0.0;
        model->held[i] = 0;
    }
    model->stale = STALE_ALL;
}

static int has_empty_range(const Model *model)
{
    for (size_t i = 0; i < N_JOINTS; i++) {
        if (!(model->values[OFFSET_JOINT_LOWER + i] < model->values[OFFSET_JOINT_UPPER + i])) return 1;
    }
    return 0;
}

ModelStatus model_check(const Model *model)
{
    if (has_empty_range(model)) return MODEL_EMPTY_RANGE;
    for (size_t i = 0; i < N_JOINTS; i++) {
        if (upper_room(model, i) < 0.0 || lower_room(model, i) < 0.0) return MODEL_BEYOND_STOP;
    }
    return MODEL_OK;
}

ModelStatus model_settle(Model *model, int *changed)
{
    *changed = 0;
    if (has_empty_range(model)) return MODEL_EMPTY_RANGE;
    for (size_t i = 0; i < N_JOINTS; i++) {
        const int side = side_met(model, i);
        if (side != 0) {
            double *position = &model->values[OFFSET_JOINT_POSITION + i];
            double *velocity = &model->values[OFFSET_JOINT_VELOCITY + i];
            const double stop = model->values[(side > 0 ? OFFSET_JOINT_UPPER : OFFSET_JOINT_LOWER) + i];
            *changed |= *position != stop || *velocity != 0.0;
            *position = stop;
            *velocity = 0.0;
        }
        model->held[i] = is_driven(model, i, side) ? side : 0;
    }
    model->stale = STALE_ALL;
    return MODEL_OK;
}

/* Finds out which joints are held, unless only events tell. */
static void hold(Model *model)
{
    for (size_t i = 0; i < N_JOINTS && !model->exchange; i++) {
        const int side = side_met(model, i);
        model->held[i] = is_driven(model, i, side) ? side : 0;
    }
}

int model_next_event(Model *model, char text[MESSAGE_SIZE])
{
    hold(model);
    for (int i = 0; i < N_JOINTS; i++) {
        const int held = model->held[i];
        if (held == model->reported[i]) continue;
        const char *state = held > 0 ? "is held by its upper stop" : held < 0 ? "is held by its lower stop" : "is free";
        (void)snprintf(text, MESSAGE_SIZE, "joint %d %s at %.9g s", i + 1, state, model->time);
        model->reported[i] = held;
        return 1;
    }
    return 0;
}

ModelStatus model_admits(size_t index, int starting, int exchanging)
{
    /* Solvers that know no other way may set states one by one. */
    if (index >= OFFSET_JOINT_POSITION && index < N_SETTABLE && !exchanging) return MODEL_NOT_SETTABLE;
    return !starting && index >= OFFSET_HOME && index < OFFSET_HOME + N_JOINTS ? MODEL_FIXED : MODEL_OK;
}

ModelStatus model_set(Model *model, size_t index, double value)
{
    if (index >= N_VALUES) return MODEL_NO_SUCH_VARIABLE;
    if (index >= N_SETTABLE) return MODEL_NOT_SETTABLE;
    if (!isfinite(value) || value < minima[index]) return MODEL_BAD_VALUE;
    model->values[index] = value;
    if (index >= OFFSET_JOINT_VELOCITY_COMMAND && index < OFFSET_JOINT_POSITION) {
        model->stale |= STALE_DERIVATIVES;
    } else {
        model->stale = STALE_ALL;
    }
    if (index < OFFSET_JOINT_VELOCITY_COMMAND) model->gain_step = -1.0;
    return MODEL_OK;
}

static void refresh_kinematics(Model *model, int part)
{
    double work[N_WORK];
    const double *arguments[2] = {model->values + OFFSET_JOINT_POSITION, model->values};
    if (part == STALE_FEATURE) {
        double *results[1] = {model->values + OFFSET_FEATURE};
        arm_feature(arguments, results, NULL, work, 0);
    } else {
        double *results[1] = {model->values + OFFSET_JACOBIAN};
        arm_jacobian(arguments, results, NULL, work, 0);
    }
    model->stale &= ~part;
}

/* Free joints meet a stop where its distance crosses zero; held ones are freed where the command does. */
static void refresh_derivatives(Model *model)
{
    hold(model);
    for (size_t i = 0; i < N_JOINTS; i++) {
        const double v = model->values[OFFSET_JOINT_VELOCITY + i], u = clipped_command(model, i);
        const int held = model->held[i];
        double *indicators = model->values + OFFSET_STOP_INDICATOR + 2 * i;
        model->values[OFFSET_DER_JOINT_POSITION + i] = held ? 0.0 : v;
        model->values[OFFSET_DER_JOINT_VELOCITY + i] = held ? 0.0 : (u - v) / continuous_lag(model, i);
        indicators[0] = held < 0 ? -u : lower_room(model, i) + STOP_HYSTERESIS;
        indicators[1] = held > 0 ? u : upper_room(model, i) + STOP_HYSTERESIS;
    }
    model->stale &= ~STALE_DERIVATIVES;
}

ModelStatus model_get(Model *model, size_t index, double *value)
{
    if (index >= N_VALUES) return MODEL_NO_SUCH_VARIABLE;
    if (index >= OFFSET_ENCODER_POSITION && index < OFFSET_FEATURE) {
        *value = encoder_position(model, index - OFFSET_ENCODER_POSITION);
        return MODEL_OK;
    }
    if (model->stale != 0 && index >= OFFSET_DER_JOINT_POSITION) {
        if (index >= OFFSET_JACOBIAN) {
            if (model->stale & STALE_JACOBIAN) refresh_kinematics(model, STALE_JACOBIAN);
        } else if (index >= OFFSET_FEATURE) {
            if (model->stale & STALE_FEATURE) refresh_kinematics(model, STALE_FEATURE);
        } else if (model->stale & STALE_DERIVATIVES) {
            refresh_derivatives(model);
        }
    }
    *value = model->values[index];
    return MODEL_OK;
}

void model_set_states(Model *model, const double *states)
{
    memcpy(model->values + OFFSET_JOINT_POSITION, states, sizeof(double) * 2 * N_JOINTS);
    model->stale = STALE_ALL;
}

/* Zero-order hold of dq/dt = v, dv/dt = (u - v) / lag; expm1 keeps the digits of a step that is short beside the lag. */
static void refresh_gains(Model *model, double step)
{
    for (size_t i = 0; i < N_JOINTS; i++) {
        const double lag = model->values[OFFSET_LAG + i];
        const double gone = lag > 0.0 ? -expm1(-step / lag) : 1.0;
        model->drift[i] = lag > 0.0 ? lag * gone : 0.0;
        model->push[i] = step - model->drift[i];
        model->decay[i] = 1.0 - gone;
    }
    model->gain_step = step;
}

ModelStatus model_step(Model *model, double step)
{
    double *position = model->values + OFFSET_JOINT_POSITION, *velocity = model->values + OFFSET_JOINT_VELOCITY;
    if (step != model->gain_step) { /* also after a parameter was set */
        const ModelStatus status = model_check(model);
        if (status != MODEL_OK) return status;
        refresh_gains(model, step);
    }
    for (size_t i = 0; i < N_JOINTS; i++) {
        const double u = clipped_command(model, i), v = velocity[i];
        const double q = position[i] + model->drift[i] * v + model->push[i] * u;
        if (!isfinite(q)) return MODEL_NOT_FINITE;
        position[i] = clip(q, model->values[OFFSET_JOINT_LOWER + i], model->values[OFFSET_JOINT_UPPER + i]);
        velocity[i] = position[i] == q ? model->decay[i] * v + (1.0 - model->decay[i]) * u : 0.0;
    }
    model->stale = STALE_ALL;
    return MODEL_OK;
}

/* The clipped command's derivative along `direction`. */
static double derive_command(const Model *model, const double *direction, size_t i)
{
    const double command = model->values[OFFSET_JOINT_VELOCITY_COMMAND + i], limit = model->values[OFFSET_MAX_SPEED + i];
    if (fabs(command) <= limit) return direction[OFFSET_JOINT_VELOCITY_COMMAND + i];
    return command > 0.0 ? direction[OFFSET_MAX_SPEED + i] : -direction[OFFSET_MAX_SPEED + i];
}

static double derive_acceleration(const Model *model, const double *direction, size_t i)
{
    const double lag = continuous_lag(model, i), v = model->values[OFFSET_JOINT_VELOCITY + i];
    const double u = clipped_command(model, i), du = derive_command(model, direction, i);
    const double dlag = model->values[OFFSET_LAG + i] > MIN_LAG ? direction[OFFSET_LAG + i] : 0.0;
    return (du - direction[OFFSET_JOINT_VELOCITY + i]) / lag - (u - v) / (lag * lag) * dlag;
}

ModelStatus model_derive(Model *model, double direction[N_VALUES], int starting)
{
    hold(model);
    if (starting) {
        memcpy(direction + OFFSET_JOINT_POSITION, direction + OFFSET_HOME, N_JOINTS * sizeof(double));
        memset(direction + OFFSET_JOINT_VELOCITY, 0, N_JOINTS * sizeof(double));
    }
    for (size_t i = 0; i < N_JOINTS; i++) {
        const int held = model->held[i];
        const double dq = direction[OFFSET_JOINT_POSITION + i], du = derive_command(model, direction, i);
        double *indicators = direction + OFFSET_STOP_INDICATOR + 2 * i;
        direction[OFFSET_DER_JOINT_POSITION + i] = held ? 0.0 : direction[OFFSET_JOINT_VELOCITY + i];
        direction[OFFSET_DER_JOINT_VELOCITY + i] = held ? 0.0 : derive_acceleration(model, direction, i);
        direction[OFFSET_ENCODER_POSITION + i] = dq; /* the mean over a step */
        indicators[0] = held < 0 ? -du : dq - direction[OFFSET_JOINT_LOWER + i];
        indicators[1] = held > 0 ? du : direction[OFFSET_JOINT_UPPER + i] - dq;
    }
    double work[N_WORK];
    const double *arguments[4] = {model->values + OFFSET_JOINT_POSITION, model->values,
                                  direction + OFFSET_JOINT_POSITION, direction};
    double *results[1] = {direction + OFFSET_FEATURE}; /* the Jacobian follows it */
    arm_forward(arguments, results, NULL, work, 0);
    return MODEL_OK;
}
