/* FMI 2.0 around `Model`: model exchange. */
#include "fmi2_instance.h"

#include <string.h>

fmi2Status fmi2EnterEventMode(fmi2Component component)
{
    OPEN("fmi2EnterEventMode", EXCHANGING);
    const char *message = core_check_stop_time(&instance->core);
    if (message == NULL) instance->core.phase = IN_EVENT;
    return answer(instance, "fmi2EnterEventMode", message);
}

fmi2Status fmi2NewDiscreteStates(fmi2Component component, fmi2EventInfo *info)
{
    OPEN("fmi2NewDiscreteStates", IN_EVENT);
    int states_changed;
    const char *message = core_update_discrete_states(&instance->core, &states_changed);
    memset(info, 0, sizeof *info);
    info->valuesOfContinuousStatesChanged = states_changed;
    report_events(instance);
    return answer(instance, "fmi2NewDiscreteStates", message);
}

fmi2Status fmi2EnterContinuousTimeMode(fmi2Component component)
{
    OPEN("fmi2EnterContinuousTimeMode", EXCHANGING);
    instance->core.phase = CONTINUOUS;
    return fmi2OK;
}

fmi2Status fmi2CompletedIntegratorStep(fmi2Component component, fmi2Boolean no_set_state, fmi2Boolean *enter_event,
                                       fmi2Boolean *terminate)
{
    (void)no_set_state;
    OPEN("fmi2CompletedIntegratorStep", CONTINUOUS);
    *enter_event = fmi2False;
    *terminate = fmi2False;
    return answer(instance, "fmi2CompletedIntegratorStep", core_check_stop_time(&instance->core));
}

fmi2Status fmi2SetTime(fmi2Component component, fmi2Real time)
{
    OPEN("fmi2SetTime", EXCHANGING);
    instance->core.model.time = time;
    return fmi2OK;
}

/* There are as many event indicators as states. */
static fmi2Status check_count(const Instance *instance, const char *function, size_t count)
{
    return answer(instance, function, count == N_STATES ? NULL : "wrong number of values");
}

fmi2Status fmi2SetContinuousStates(fmi2Component component, const fmi2Real states[], size_t count)
{
    OPEN("fmi2SetContinuousStates", EXCHANGING);
    const fmi2Status status = check_count(instance, "fmi2SetContinuousStates", count);
    if (status == fmi2OK) model_set_states(&instance->core.model, states);
    return status;
}

static void copy_values(Instance *instance, size_t offset, fmi2Real values[])
{
    for (size_t i = 0; i != N_STATES; i++) model_get(&instance->core.model, offset + i, &values[i]);
}

fmi2Status fmi2GetDerivatives(fmi2Component component, fmi2Real derivatives[], size_t count)
{
    OPEN("fmi2GetDerivatives", RUNNING | TERMINATED);
    const fmi2Status status = check_count(instance, "fmi2GetDerivatives", count);
    if (status == fmi2OK) copy_values(instance, OFFSET_DERIVATIVES, derivatives);
    return status;
}

fmi2Status fmi2GetEventIndicators(fmi2Component component, fmi2Real indicators[], size_t count)
{
    OPEN("fmi2GetEventIndicators", READABLE);
    const fmi2Status status = check_count(instance, "fmi2GetEventIndicators", count);
    if (status == fmi2OK) copy_values(instance, OFFSET_INDICATORS, indicators);
    return status;
}

fmi2Status fmi2GetContinuousStates(fmi2Component component, fmi2Real states[], size_t count)
{
    OPEN("fmi2GetContinuousStates", READABLE);
    const fmi2Status status = check_count(instance, "fmi2GetContinuousStates", count);
    if (status == fmi2OK) copy_values(instance, OFFSET_STATES, states);
    return status;
}

fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component component, fmi2Real nominals[], size_t count)
{
    OPEN("fmi2GetNominalsOfContinuousStates", ~0);
    const fmi2Status status = check_count(instance, "fmi2GetNominalsOfContinuousStates", count);
    for (size_t i = 0; status == fmi2OK && i < count; i++) nominals[i] = 1.0;
    return status;
}
