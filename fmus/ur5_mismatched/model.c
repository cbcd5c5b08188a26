#include "model.h"
#include "kinematics.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

/* In continuous time a lag of zero would make the equations algebraic; below this it counts as this. */
#define MIN_LAG 1e-6
/* How far behind its stop a joint meets it [rad]; a joint that leaves a stop does not meet it at once that way. */
#define STOP_HYSTERESIS 1e-9
#define MAX_PARTS 1000.0 /* of a step; an importer may ask for one of any length */
#define QUOTED(text) #text
#define IN_WORDS(number) QUOTED(number)

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

static double gear_position(const Model *model, size_t i)
{
    const double q = model->values[OFFSET_JOINT_POSITION + i], a = model->values[OFFSET_RIPPLE + i];
    return q + a * sin(model->values[OFFSET_RIPPLE_ORDER + i] * q);
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

/* How far each joint is from its gear, within the play. */
static void find_play(const Model *model, double play[N_JOINTS])
{
    for (size_t i = 0; i < N_JOINTS; i++) {
        const double gear = gear_position(model, i), most = model->values[OFFSET_BACKLASH + i], x = model->driven[i];
        play[i] = x <= gear - most ? -most : x >= gear + most ? most : x - gear;
    }
}

void model_accept(Model *model)
{
    double play[N_JOINTS];
    find_play(model, play);
    for (size_t i = 0; i < N_JOINTS; i++) model->driven[i] = gear_position(model, i) + play[i];
}

typedef int CoreFunction(const double **arg, double **res, int *iw, double *w, int mem);

/* Evaluates a function of the core, along a direction if it takes one; results that are not wanted are NULL. */
static void evaluate(CoreFunction *function, const Model *model, const double *direction, double *first, double *second)
{
    double work[N_WORK], play[N_JOINTS];
    find_play(model, play);
    const double *states = direction == NULL ? NULL : direction + OFFSET_STATES;
    const double *arguments[5] = {model->values + OFFSET_STATES, model->values, play, states, direction};
    double *results[2] = {first, second};
    function(arguments, results, NULL, work, 0);
}

static int is_flexible(const Model *model) { return model->values[OFFSET_TOOL_FREQUENCY] > 0.0; }

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
        model->driven[i] = gear_position(model, i);
    }
    memset(model->values + OFFSET_TOOL_DEFLECTION, 0, 6 * sizeof(double));
    model->flexible = is_flexible(model);
    model->stale = STALE_ALL;
}

/* Gives a tool that became flexible no deflection and the velocity of a rigid one; returns whether states changed. */
static int match_tool(Model *model)
{
    double motion[6] = {0.0}; /* place and velocity of a rigid tool; zeros for one that became rigid */
    if (model->flexible == is_flexible(model)) return 0;
    model->flexible = !model->flexible;
    if (model->flexible) evaluate(arm_motion, model, NULL, motion, NULL);
    memset(motion, 0, 3 * sizeof(double));
    memcpy(model->values + OFFSET_TOOL_DEFLECTION, motion, sizeof motion);
    return 1;
}

static const char *check_ranges(const Model *model)
{
    const double frequency = model->values[OFFSET_TOOL_FREQUENCY];
    if (frequency != 0.0 && !(frequency >= MIN_FREQUENCY && frequency <= MAX_FREQUENCY)) {
        return "tool_frequency is neither 0 nor from " IN_WORDS(MIN_FREQUENCY) " to " IN_WORDS(MAX_FREQUENCY) " rad/s";
    }
    if (!(model->values[OFFSET_TOOL_DAMPING] < 1.0)) return "tool_damping is not below 1";
    for (size_t i = 0; i < N_JOINTS; i++) {
        const double lower = model->values[OFFSET_JOINT_LOWER + i], upper = model->values[OFFSET_JOINT_UPPER + i];
        if (!(lower < upper)) return "joint_lower is not below joint_upper";
    }
    return NULL;
}

const char *model_check(const Model *model, double step)
{
    const char *message = check_ranges(model);
    for (size_t i = 0; message == NULL && i < N_JOINTS; i++) {
        const int inside = upper_room(model, i) >= 0.0 && lower_room(model, i) >= 0.0;
        if (!inside) message = "a joint is beyond its stops joint_lower and joint_upper";
    }
    return message;
}

const char *model_settle(Model *model, int *changed)
{
    const char *message = check_ranges(model);
    *changed = 0;
    if (message != NULL) return message;
    *changed = match_tool(model);
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
    model_accept(model);
    model->stale = STALE_ALL;
    return NULL;
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

const char *model_set(Model *model, size_t index, double value, int starting)
{
    if (!starting && index >= OFFSET_HOME && index < OFFSET_HOME + N_JOINTS) {
        return "this parameter is fixed: it can be set before the end of initialisation only";
    }
    if (!isfinite(value) || value < minima[index]) return "the value is not finite or below the variable's minimum";
    model->values[index] = value;
    if (index >= OFFSET_JOINT_VELOCITY_COMMAND && index < OFFSET_JOINT_POSITION) {
        model->stale |= STALE_DERIVATIVES;
    } else {
        model->stale = STALE_ALL;
    }
    if (index < OFFSET_JOINT_VELOCITY_COMMAND) model->gain_step = -1.0;
    return NULL;
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
    evaluate(arm_motion, model, NULL, NULL, model->values + OFFSET_DER_TOOL_DEFLECTION);
}

/* Computes the part of the values that is out of date and holds `index`. */
static void refresh(Model *model, size_t index)
{
    const int part = index >= OFFSET_JACOBIAN  ? STALE_JACOBIAN
                     : index >= OFFSET_FEATURE ? STALE_FEATURE
                                               : STALE_DERIVATIVES;
    if ((model->stale & part) == 0) return;
    if (part == STALE_DERIVATIVES) refresh_derivatives(model);
    if (part == STALE_FEATURE) evaluate(arm_feature, model, NULL, model->values + OFFSET_FEATURE, NULL);
    if (part == STALE_JACOBIAN) evaluate(arm_jacobian, model, NULL, model->values + OFFSET_JACOBIAN, NULL);
    model->stale &= ~part;
}

const char *model_get(Model *model, size_t index, double *value)
{
    if (index >= OFFSET_ENCODER_POSITION && index < OFFSET_FEATURE) {
        *value = encoder_position(model, index - OFFSET_ENCODER_POSITION);
        return NULL;
    }
    if (index >= OFFSET_DER_JOINT_POSITION) refresh(model, index);
    *value = model->values[index];
    return NULL;
}

void model_set_states(Model *model, const double *states)
{
    memcpy(model->values + OFFSET_STATES, states, sizeof(double) * N_STATES);
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

static const char *move_joints(Model *model)
{
    double *position = model->values + OFFSET_JOINT_POSITION, *velocity = model->values + OFFSET_JOINT_VELOCITY;
    for (size_t i = 0; i < N_JOINTS; i++) {
        const double u = clipped_command(model, i), v = velocity[i];
        const double q = position[i] + model->drift[i] * v + model->push[i] * u;
        if (!isfinite(q)) return "a joint position is not finite";
        position[i] = clip(q, model->values[OFFSET_JOINT_LOWER + i], model->values[OFFSET_JOINT_UPPER + i]);
        velocity[i] = position[i] == q ? model->decay[i] * v + (1.0 - model->decay[i]) * u : 0.0;
    }
    model_accept(model);
    return NULL;
}

/* The tool a step later, in closed form: the velocity of a rigid one is a parabola with the right distance. */
static void swing_tool(Model *model, double step, const double before[6], const double after[6])
{
    double *deflection = model->values + OFFSET_TOOL_DEFLECTION, *velocity = model->values + OFFSET_TOOL_VELOCITY;
    const double omega = model->values[OFFSET_TOOL_FREQUENCY], sigma = model->values[OFFSET_TOOL_DAMPING] * omega;
    const double square = omega * omega, damped = sqrt(square - sigma * sigma), left = exp(-sigma * step);
    const double c = cos(damped * step), s = sin(damped * step) / damped;
    for (size_t k = 0; k < 3; k++) {
        const double from = before[3 + k], to = after[3 + k];
        const double bend = 3.0 * (from + to) - 6.0 * (after[k] - before[k]) / step;
        const double drift = -2.0 * bend / (step * step * square);
        const double centre = (from - to + bend) / (step * square) - 2.0 * sigma * drift / square;
        const double d = deflection[k] - centre, r = velocity[k] - from - drift;
        deflection[k] = centre + drift * step + left * ((c + sigma * s) * d + s * r);
        velocity[k] = to + drift + left * ((c - sigma * s) * r - square * s * d);
    }
}

static double count_parts(const Model *model, double step)
{
    int whole = model->values[OFFSET_TOOL_FREQUENCY] == 0.0;
    for (size_t i = 0; i < N_JOINTS; i++) whole &= model->values[OFFSET_BACKLASH + i] == 0.0;
    return whole ? 1.0 : fmin(fmax(1.0, ceil(step / MAX_PART - 1e-9)), MAX_PARTS);
}

const char *model_step(Model *model, double step)
{
    const double parts = count_parts(model, step), part = step / parts;
    double before[6], after[6];
    if (part != model->gain_step) refresh_gains(model, part); /* also after a parameter was set */
    (void)match_tool(model);
    if (model->flexible) evaluate(arm_motion, model, NULL, after, NULL);
    for (double done = 0.0; done < parts; done += 1.0) {
        const char *message = move_joints(model);
        if (message != NULL) return message;
        if (!model->flexible) continue;
        memcpy(before, after, sizeof before);
        evaluate(arm_motion, model, NULL, after, NULL);
        swing_tool(model, part, before, after);
    }
    model->stale = STALE_ALL;
    return NULL;
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

const char *model_derive(Model *model, double direction[N_VALUES], int starting)
{
    hold(model);
    if (starting) {
        memcpy(direction + OFFSET_JOINT_POSITION, direction + OFFSET_HOME, N_JOINTS * sizeof(double));
        memset(direction + OFFSET_JOINT_VELOCITY, 0, (N_STATES - N_JOINTS) * sizeof(double));
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
    /* The Jacobian follows the feature. */
    evaluate(arm_forward, model, direction, direction + OFFSET_FEATURE, direction + OFFSET_DER_TOOL_DEFLECTION);
    return NULL;
}
