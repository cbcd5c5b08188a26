/* Directional and adjoint derivatives of FMI 3.0: products with the matrix of the unknowns' derivatives by the knowns. */
#include "fmi3_instance.h"
#include <string.h>

/* Whether variables exist, begin below `end` and have `n` values together. */
static const char *check(const fmi3ValueReference references[], size_t count, size_t end, size_t n)
{
    size_t k = 0;
    for (size_t i = 0; i < count; i++) {
        const size_t size = size_of(references[i]);
        if (size == 0 || references[i] >= end) return end == N_VALUES ? "this is no unknown" : "this is no known";
        k += size;
    }
    return k < n ? "too many values for these variables" : k > n ? "too few values for these variables" : NULL;
}

/* Turns `direction`, set for the knowns, into the derivatives of all values along it. */
static const char *derive(Instance *self, double direction[N_VALUES])
{
    return model_explain(model_derive(&self->core.model, direction, self->core.phase == INITIALISING));
}

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance instance, const fmi3ValueReference unknowns[], size_t n_unknowns,
                                        const fmi3ValueReference knowns[], size_t n_knowns, const fmi3Float64 seed[],
                                        size_t n_seed, fmi3Float64 sensitivity[], size_t n_sensitivity)
{
    OPEN(DIFFERENTIABLE);
    double direction[N_VALUES] = {0.0};
    const char *message = check(knowns, n_knowns, N_SETTABLE, n_seed);
    if (message == NULL) message = check(unknowns, n_unknowns, N_VALUES, n_sensitivity);
    for (size_t i = 0; message == NULL && i < n_knowns; seed += size_of(knowns[i++])) {
        memcpy(direction + knowns[i], seed, size_of(knowns[i]) * sizeof(double));
    }
    if (message == NULL) message = derive(self, direction);
    for (size_t i = 0; message == NULL && i < n_unknowns; sensitivity += size_of(unknowns[i++])) {
        memcpy(sensitivity, direction + unknowns[i], size_of(unknowns[i]) * sizeof(double));
    }
    return ANSWER(message);
}

/* The sum of the unknowns along a direction, each times its seed. */
static double weighed(const double direction[N_VALUES], const fmi3ValueReference unknowns[], size_t n_unknowns,
                      const fmi3Float64 seed[])
{
    double sum = 0.0;
    for (size_t i = 0; i < n_unknowns; i++) {
        for (size_t j = 0; j < size_of(unknowns[i]); j++) sum += *seed++ * direction[unknowns[i] + j];
    }
    return sum;
}

/* The transposed product, from one direction for each known: the model has some hundred values, and no tape. */
fmi3Status fmi3GetAdjointDerivative(fmi3Instance instance, const fmi3ValueReference unknowns[], size_t n_unknowns,
                                    const fmi3ValueReference knowns[], size_t n_knowns, const fmi3Float64 seed[],
                                    size_t n_seed, fmi3Float64 sensitivity[], size_t n_sensitivity)
{
    OPEN(DIFFERENTIABLE);
    const char *message = check(knowns, n_knowns, N_SETTABLE, n_sensitivity);
    if (message == NULL) message = check(unknowns, n_unknowns, N_VALUES, n_seed);
    for (size_t i = 0; message == NULL && i < n_knowns; i++) {
        for (size_t j = 0; message == NULL && j < size_of(knowns[i]); j++) {
            double direction[N_VALUES] = {0.0};
            direction[knowns[i] + j] = 1.0;
            message = derive(self, direction);
            if (message == NULL) *sensitivity++ = weighed(direction, unknowns, n_unknowns, seed);
        }
    }
    return ANSWER(message);
}
