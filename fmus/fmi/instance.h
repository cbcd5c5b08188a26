/* What both FMI layers need beside the model: the phase of the instance and its saved state. */
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

enum { RUNNING = STEPPING | IN_EVENT | CONTINUOUS, READABLE = INITIALISING | RUNNING | TERMINATED | FAILED };

typedef struct {
    char token[64]; /* of the model that saved it: a state of another model is refused */
    Model model;
    Phase phase;
} Snapshot;

/* NULL without memory. */
Snapshot *snapshot_take(const Model *model, Phase phase);
/* NULL if `bytes` are not the state of this model. */
Snapshot *snapshot_read(const void *bytes, size_t size);

#define MESSAGE_SIZE 256
/* Writes "function: message". Importers without printf formatting get whole texts that way. */
void compose(char text[MESSAGE_SIZE], const char *function, const char *message);

const char *explain(ModelStatus status);

#endif
