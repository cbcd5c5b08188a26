/* A planar arm of two joints; it shares nothing with the exported FMUs. */
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

enum { STEP_FAILS = 1, RESULT_IS_NAN, ENDS_HALF_WAY, NO_PROGRESS, NO_START, ENDS_SIMULATION, BECOMES_NAN, CREEPS, DIES };

int terminated, called_after_fatal; /* how often; for tests */
static bool dead;

typedef struct {
    double time, wheel[2], push[2], place[2], arm[2], quirk, rate[2];
    int gear; /* times the speed */
    bool on, configuring;
    float trim; /* times the speed, too */
    char mood[16]; /* "contrary" turns it round */
    unsigned long long samples;
} Crane;

static void place(Crane *c)
{
    c->place[0] = c->arm[0] * cos(c->wheel[0]) + c->arm[1] * cos(c->wheel[0] + c->wheel[1]);
    c->place[1] = c->arm[0] * sin(c->wheel[0]) + c->arm[1] * sin(c->wheel[0] + c->wheel[1]);
    if (c->quirk == RESULT_IS_NAN || (c->quirk == BECOMES_NAN && c->time > 0.2)) c->place[1] = NAN;
}

static void init(Crane *c)
{
    c->wheel[0] = 0.3;
    c->wheel[1] = 1.2;
    c->arm[0] = 0.5;
    c->arm[1] = 0.4;
    c->quirk = 0;
    c->gear = 1;
    c->on = true;
    c->trim = 1.0f;
    c->mood[0] = 0;
    c->samples = 1;
}

static void move(Crane *c, double h)
{
    const double share = c->on * c->gear * (double)c->trim * (strcmp(c->mood, "contrary") == 0 ? -1 : 1);
    for (int i = 0; i < 2; i++) c->wheel[i] += h * share * c->push[i];
    c->time += h;
    place(c);
}

static int set_mood(Crane *c, size_t n, const char *const values[])
{
    strncpy(c->mood, values[0], sizeof c->mood - 1);
    return n == 1 ? 0 : 3;
}

/* References: 10 and 11 wheel, 20 and 21 push, 30 and 31 place, 40 and 41 arm, 50 quirk, 60 and 61 rate. */
static double *at(Crane *c, unsigned reference)
{
    double *groups[] = {c->wheel, c->push, c->place, c->arm, &c->quirk, c->rate};
    return groups[reference / 10 - 1] + reference % 10;
}
