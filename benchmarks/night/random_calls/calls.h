/* What the random calls of FMI 2 and FMI 3 share: numbers, references, and how a program of calls goes on. */
#ifndef CALLS_H
#define CALLS_H

#include "model.h"
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { INSTANCES = 4, STATES = 6, MAX_COUNT = 40 };

static uint64_t generator;

static uint64_t draw(void) /* xorshift64* */
{
    generator ^= generator >> 12;
    generator ^= generator << 25;
    generator ^= generator >> 27;
    return generator * 2685821657736338717u;
}

static unsigned below(unsigned count) { return (unsigned)((draw() >> 33) % count); }

static double number(void)
{
    static const double odd[] = {0.0, -0.0, 1.0, -1.0, 1e308, -1e308, 5e-324, 1e-9, 6.283185307179586, 1e16};
    switch (below(12)) {
    case 0: return NAN;
    case 1: return below(2) ? INFINITY : -INFINITY;
    case 2: return odd[below(sizeof odd / sizeof *odd)];
    default: return ((double)(draw() >> 11) / 9007199254740992.0 - 0.5) * 4.0;
    }
}

/* Usually of a variable, sometimes just beside them, sometimes far away. */
static uint32_t reference(void)
{
    switch (below(12)) {
    case 0: return N_VALUES + below(3);
    case 1: return (uint32_t)draw();
    case 2: return OFFSET_JOINT_POSITION;
    default: return below(N_VALUES);
    }
}

/* Blocks of exactly the size that is told, so that one byte too many is seen; NULL for none where that is allowed. */
static void *block(size_t size) { return size == 0 && below(2) ? NULL : malloc(size ? size : 1); }

static uint32_t *references(size_t count)
{
    uint32_t *made = block(count * sizeof *made);
    for (size_t i = 0; i < count; i++) made[i] = reference();
    return made;
}

static double *numbers(size_t count)
{
    double *made = block(count * sizeof *made);
    for (size_t i = 0; i < count; i++) made[i] = number();
    return made;
}

static size_t few(void) { return below(8) ? below(4) : below(MAX_COUNT); }

/* Carries out one call; returns its status. */
static int call(void);
static void begin(void);
static void end(void);

int main(int count, char **words)
{
    const uint64_t calls = count > 1 ? strtoull(words[1], NULL, 10) : 100000;
    generator = (count > 2 ? strtoull(words[2], NULL, 10) : 0) * 2 + 88172645463325253u;
    uint64_t refused = 0;
    begin();
    for (uint64_t i = 0; i < calls; i++) refused += call() > 1;
    end();
    printf("%llu calls, %llu refused\n", (unsigned long long)calls, (unsigned long long)refused);
    return 0;
}

#endif
