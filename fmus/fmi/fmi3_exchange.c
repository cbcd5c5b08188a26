/* FMI 3.0 around `Model`: model exchange. */
#include "fmi3_instance.h"

fmi3Status fmi3EnterEventMode(fmi3Instance instance)
{
    OPEN("fmi3EnterEventMode", EXCHANGING);
    const char *message = core_check_stop_time(&self->core);
    if (message == NULL) self->core.phase = IN_EVENT;
    return answer(self, "fmi3EnterEventMode", message);
}

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance instance, fmi3Boolean *again, fmi3Boolean *terminate,
                                    fmi3Boolean *nominals_changed, fmi3Boolean *states_changed,
                                    fmi3Boolean *next_event_defined, fmi3Float64 *next_event)
{
    OPEN("fmi3UpdateDiscreteStates", IN_EVENT);
    int changed;
    const char *message = core_update_discrete_states(&self->core, &changed);
    *again = *terminate = *nominals_changed = *next_event_defined = false;
    *states_changed = changed != 0;
    *next_event = 0.0;
    report_events(self);
    return answer(self, "fmi3UpdateDiscreteStates", message);
}

fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance instance)
{
    OPEN("fmi3EnterContinuousTimeMode", EXCHANGING);
    self->core.phase = CONTINUOUS;
    return fmi3OK;
}

fmi3Status fmi3CompletedIntegratorStep(fmi3Instance instance, fmi3Boolean no_set_state, fmi3Boolean *enter_event,
                                       fmi3Boolean *terminate)
{
    (void)no_set_state;
    OPEN("fmi3CompletedIntegratorStep", CONTINUOUS);
    *enter_event = *terminate = false;
    return answer(self, "fmi3CompletedIntegratorStep", core_check_stop_time(&self->core));
}

fmi3Status fmi3SetTime(fmi3Instance instance, fmi3Float64 time)
{
    OPEN("fmi3SetTime", EXCHANGING);
    self->core.model.time = time;
    return fmi3OK;
}

/* There are as many event indicators as states. */
static fmi3Status check_count(const Instance *self, const char *function, size_t count)
{
    return answer(self, function, count == N_STATES ? NULL : "wrong number of values");
}

fmi3Status fmi3SetContinuousStates(fmi3Instance instance, const fmi3Float64 states[], size_t count)
{
    OPEN("fmi3SetContinuousStates", EXCHANGING);
    const fmi3Status status = check_count(self, "fmi3SetContinuousStates", count);
    if (status == fmi3OK) model_set_states(&self->core.model, states);
    return status;
}

static fmi3Status copy_values(Instance *self, const char *function, size_t offset, fmi3Float64 values[], size_t count)
{
    const fmi3Status status = check_count(self, function, count);
    for (size_t i = 0; status == fmi3OK && i < count; i++) core_get(&self->core, offset + i, &values[i]);
    return status;
}

fmi3Status fmi3GetContinuousStates(fmi3Instance instance, fmi3Float64 states[], size_t count)
{
    OPEN("fmi3GetContinuousStates", READABLE);
    return copy_values(self, "fmi3GetContinuousStates", OFFSET_STATES, states, count);
}

fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance instance, fmi3Float64 derivatives[], size_t count)
{
    OPEN("fmi3GetContinuousStateDerivatives", READABLE);
    return copy_values(self, "fmi3GetContinuousStateDerivatives", OFFSET_DERIVATIVES, derivatives, count);
}

fmi3Status fmi3GetEventIndicators(fmi3Instance instance, fmi3Float64 indicators[], size_t count)
{
    OPEN("fmi3GetEventIndicators", READABLE);
    return copy_values(self, "fmi3GetEventIndicators", OFFSET_INDICATORS, indicators, count);
}

fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance instance, fmi3Float64 nominals[], size_t count)
{
    OPEN("fmi3GetNominalsOfContinuousStates", ~0);
    const fmi3Status status = check_count(self, "fmi3GetNominalsOfContinuousStates", count);
    for (size_t i = 0; status == fmi3OK && i < count; i++) nominals[i] = 1.0;
    return status;
}

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance instance, size_t *count)
{
    OPEN("fmi3GetNumberOfContinuousStates", ~0);
    *count = N_STATES;
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance instance, size_t *count)
{
    OPEN("fmi3GetNumberOfEventIndicators", ~0);
    *count = N_STATES;
    return fmi3OK;
}
