#include "instance.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

Snapshot *snapshot_take(const Model *model, Phase phase)
{
    Snapshot *snapshot = calloc(1, sizeof *snapshot);
    if (snapshot == NULL) return NULL;
    strncpy(snapshot->token, TOKEN, sizeof snapshot->token - 1);
    memcpy(&snapshot->model, model, sizeof *model);
    snapshot->phase = phase;
    return snapshot;
}

Snapshot *snapshot_read(const void *bytes, size_t size)
{
    Snapshot *snapshot = size == sizeof *snapshot ? malloc(size) : NULL;
    if (snapshot == NULL) return NULL;
    memcpy(snapshot, bytes, size);
    if (memcmp(snapshot->token, TOKEN, sizeof TOKEN) != 0) {
        free(snapshot);
        return NULL;
    }
    return snapshot;
}

void compose(char text[MESSAGE_SIZE], const char *function, const char *message)
{
    snprintf(text, MESSAGE_SIZE, "%s: %s", function, message);
}

const char *explain(ModelStatus status)
{
    switch (status) {
    case MODEL_NO_SUCH_VARIABLE: return "there is no variable with this value reference";
    case MODEL_NOT_SETTABLE: return "this variable is computed by the model and cannot be set";
    case MODEL_BAD_VALUE: return "the value is not finite or below the variable's minimum";
    default: return "no error";
    }
}
