/* The common part of FMI 2 and FMI 3 beside the model: phases, time, variables, derivatives, saved states.

   A model is a folder with model.h and model.c. Its Model has `time` and `exchange`; the offsets and sizes of its
   variables are in the generated layout.h, its functions in model_functions.h. */
#ifndef INSTANCE_H
#define INSTANCE_H

#include "model.h"

typedef enum {
    INSTANTIATED = 1,
    INITIALISING = 2,
    STEPPING = 4,
    IN_EVENT = 8,
    CONTINUOUS = 16,
    TERMINATED = 32,
    FAILED = 64
} Phase;

enum {
    STARTING = INSTANTIATED | INITIALISING,
    EXCHANGING = IN_EVENT | CONTINUOUS,
    RUNNING = STEPPING | EXCHANGING,
    READABLE = INITIALISING | RUNNING | TERMINATED | FAILED,
    DIFFERENTIABLE = INITIALISING | RUNNING | TERMINATED
};

/* Bits of the log categories, in the order of their names in `log_categories`. */
enum { LOG_ERRORS = 1, LOG_WARNINGS = 2, LOG_EVENTS = 4, LOG_ALL = 7, N_CATEGORIES = 3 };
extern const char *const log_categories[N_CATEGORIES];

/* The part of an instance that a saved state holds. */
typedef struct {
    Model model;
    Phase phase;
    double stop_time; /* infinite if none was given */
} Core;

typedef struct {
    char token[64]; /* of the model that saved it: a state of another model is refused */
    Core core;
    unsigned long long checksum;
} Snapshot;

void core_reset(Core *core, int exchange);
const char *core_begin(Core *core, double start, int stop_defined, double stop);
const char *core_leave_initialisation(Core *core);
const char *core_step(Core *core, double time, double step);
/* Solvers evaluate the equations beyond the stop time as well; ends of steps and changes of states may not lie there. */
const char *core_check_stop_time(const Core *core);

/* Number of values behind a reference, 0 if there is no such variable; each version of FMI defines it. */
size_t size_of(unsigned reference);
/* Variables by their references, with room for `n_values` values. */
typedef struct {
    const unsigned *references;
    size_t count;
    size_t n_values;
} Variables;

const char *core_get(Core *core, Variables variables, double values[]);
const char *core_set(Core *core, Variables variables, const double values[]);
/* The product of the matrix of the unknowns' derivatives by the knowns with `seed`, or of its transpose. */
const char *core_derive(Core *core, Variables unknowns, Variables knowns, const double seed[], double product[]);
const char *core_derive_adjoint(Core *core, Variables unknowns, Variables knowns, const double seed[], double product[]);

/* NULL without memory. */
Snapshot *snapshot_take(const Core *core);
/* NULL if `bytes` are not an intact state of this model. */
Snapshot *snapshot_read(const void *bytes, size_t size);
const char *core_restore(Core *core, const Snapshot *snapshot);

/* The bits that a list of categories stands for, all of them for an empty list; 0 if one is unknown. */
unsigned category_bits(size_t count, const char *const categories[]);

#endif
