/* The common part of FMI 2 and FMI 3 beside the model: phases, time, saved states, messages.

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

/* A function that returns text returns NULL where all is well, and otherwise a message for the user. */

void core_reset(Core *core, int exchange);
const char *core_begin(Core *core, double start, int stop_defined, double stop);
const char *core_leave_initialisation(Core *core);
const char *core_get(Core *core, size_t index, double *value);
const char *core_set(Core *core, size_t index, double value);
const char *core_step(Core *core, double time, double step);
/* Solvers evaluate the equations beyond the stop time as well; ends of steps and changes of states may not lie there. */
const char *core_check_stop_time(const Core *core);
const char *core_update_discrete_states(Core *core, int *states_changed);
/* NULL without memory. */
Snapshot *snapshot_take(const Core *core);
/* NULL if `bytes` are not an intact state of this model. */
Snapshot *snapshot_read(const void *bytes, size_t size);
const char *core_restore(Core *core, const Snapshot *snapshot);

/* How a function of either version begins, and how it ends with a message or NULL; the header of the instance defines
   Instance and STATUS_ERROR. */
#define OPEN(phases)                       \
    Instance *const self = instance;       \
    if (self == NULL) return STATUS_ERROR; \
    if ((self->core.phase & (phases)) == 0) return ANSWER("not allowed in this phase")
#define ANSWER(message) answer(self, __func__, message)

/* Writes "function: message". Importers without printf formatting get whole texts that way. */
void compose(char text[MESSAGE_SIZE], const char *function, const char *message);
/* The bits that a list of categories stands for, all of them for an empty list; 0 if one is unknown. */
unsigned category_bits(size_t count, const char *const categories[]);

#endif
