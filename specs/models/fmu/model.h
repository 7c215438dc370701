/* What an FMU of these models is made of. All variables are doubles in one array; value reference = index.

   The generated table.h says NX (continuous states, first in the array; their derivatives follow), NZ (event indicators), NV
   (variables), KIND and START per variable, TOKEN, and an index per name; the model says how derivatives and outputs follow
   from the rest, and what happens at an event. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { PARAMETER, INPUT, STATE, OUTPUT };
#include "table.h"

typedef struct {
    double v[NV];
    double time;
    int settable; /* states and parameters may be set: until the initialization ends */
} Instance;

/* The longest step of the co-simulation's own solver. */
#ifndef LONGEST
#define LONGEST 1e-3
#endif

static void derive(double *v, double time);
static void indicate(const double *v, double *z);
static int event(double *v);
#include MODEL

static void start(Instance *i) {
    memcpy(i->v, START, sizeof START);
    i->time = 0;
    i->settable = 1;
}

static int allowed(const Instance *i, unsigned reference) {
    return reference < NV && (KIND[reference] == INPUT || (i->settable && KIND[reference] != OUTPUT));
}

static void rk4(double *v, double t, double h) {
    double x[NX], k[4][NX];
    const double at[4] = {0, 0.5, 0.5, 1};
    memcpy(x, v, sizeof x);
    for (int s = 0; s < 4; s++) {
        for (int j = 0; j < NX; j++) v[j] = x[j] + (s ? at[s] * h * k[s - 1][j] : 0);
        derive(v, t + at[s] * h);
        memcpy(k[s], v + NX, sizeof x);
    }
    for (int j = 0; j < NX; j++) v[j] = x[j] + h / 6 * (k[0][j] + 2 * k[1][j] + 2 * k[2][j] + k[3][j]);
    derive(v, t + h);
}

/* Equal steps of at most LONGEST; an event is seen at the end of a step. */
static void cosimulate(Instance *i, double t, double h) {
    const int n = (int)ceil(h / LONGEST - 1e-9);
    for (int k = 0; k < n; k++) {
        rk4(i->v, t + k * h / n, h / n);
        while (event(i->v)) derive(i->v, t + (k + 1) * h / n);
    }
    i->time = t + h;
}
