/* An oscillator as an FMU, for FMI 2 and 3 (-DFMI=2, -DFMI=3), without the standard's headers.

   x0' = x1,  x1' = mu (1 - q) x1 - k x0 + u,  with q = x0^2 (van der Pol) or, if it is linear,
   q = 2 (a damped spring). Fixed steps of a 16th of the communication step, Runge-Kutta of order 4.
   It can be told to fail, to end the simulation, to print and to log. */

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { X0, X1, U, MU, K, LINEAR, ENERGY, FAIL_AT, FAIL_STATUS, NOISY, START, NAME, VARIABLES };
enum { OK, WARNING, DISCARD, ERROR, FATAL };

typedef void (*logger2)(void *, const char *, int, const char *, const char *, ...);
typedef void (*logger3)(void *, int, const char *, const char *);

typedef struct {
    double v[VARIABLES];
    double t;
    logger2 say2;
    logger3 say3;
} oscillator;

static void say(oscillator *o, int status, const char *text) {
    if (o->say2)
        o->say2(NULL, "o", status, "all", "%s at %g", text, o->t);
    if (o->say3)
        o->say3(NULL, status, "all", text);
}

static void derivative(const oscillator *o, const double *x, double *dx) {
    double q = o->v[LINEAR] != 0 ? 2 : x[0] * x[0];
    dx[0] = x[1];
    dx[1] = o->v[MU] * (1 - q) * x[1] - o->v[K] * x[0] + o->v[U];
}

static void rk4(oscillator *o, double h) {
    double *x = o->v, a[2], b[2], c[2], d[2], y[2];
    derivative(o, x, a);
    for (int i = 0; i < 2; i++)
        y[i] = x[i] + h / 2 * a[i];
    derivative(o, y, b);
    for (int i = 0; i < 2; i++)
        y[i] = x[i] + h / 2 * b[i];
    derivative(o, y, c);
    for (int i = 0; i < 2; i++)
        y[i] = x[i] + h * c[i];
    derivative(o, y, d);
    for (int i = 0; i < 2; i++)
        x[i] += h / 6 * (a[i] + 2 * b[i] + 2 * c[i] + d[i]);
}

static void look(oscillator *o) {
    o->v[ENERGY] = (o->v[X1] * o->v[X1] + o->v[K] * o->v[X0] * o->v[X0]) / 2;
}

static int step(oscillator *o, double t, double h) {
    if (fabs(t - o->t) > 1e-9) {
        say(o, ERROR, "not where I am");
        return ERROR;
    }
    if (o->v[NOISY] != 0) {
        printf("a line on standard output\n");
        fprintf(stderr, "a line on standard error\n");
        say(o, WARNING, "a line in the log");
    }
    if (t >= o->v[FAIL_AT] - 1e-9 && o->v[FAIL_STATUS] != OK) {
        if (o->v[FAIL_STATUS] > WARNING)
            say(o, (int)o->v[FAIL_STATUS], "the spring broke");
        return (int)o->v[FAIL_STATUS];
    }
    for (int i = 0; i < 16; i++)
        rk4(o, h / 16);
    o->t = t + h;
    look(o);
    return OK;
}

static oscillator *made(const char *token) {
    if (strcmp(token, "{oscillator}"))
        return NULL;
    oscillator *o = calloc(1, sizeof *o);
    o->v[MU] = o->v[K] = 1;
    o->v[FAIL_AT] = 1e9;
    return o;
}

static int initialised(oscillator *o) {
    if (o->v[START] != 0)
        o->v[X0] = o->v[START];
    look(o);
    return OK;
}

#define GET(type)                                                                                  \
    for (size_t i = 0; i < n; i++)                                                                 \
        values[i] = (type)o->v[references[i]];                                                     \
    return OK;
#define SET                                                                                        \
    for (size_t i = 0; i < n; i++)                                                                 \
        o->v[references[i]] = values[i];                                                           \
    return OK;
typedef const unsigned *refs;

#if FMI == 2

struct callbacks {
    logger2 logger;
};
const char *fmi2GetVersion(void) { return "2.0"; }
const char *fmi2GetTypesPlatform(void) { return "default"; }
void *fmi2Instantiate(
    const char *name, int kind, const char *guid, const char *where, const struct callbacks *calls,
    int visible, int logging) {
    oscillator *o = made(guid);
    if (o)
        o->say2 = calls->logger;
    return o;
}
void fmi2FreeInstance(oscillator *o) { free(o); }
int fmi2SetupExperiment(oscillator *o, int a, double b, double c, int d, double e) { return OK; }
int fmi2EnterInitializationMode(oscillator *o) { return OK; }
int fmi2ExitInitializationMode(oscillator *o) { return initialised(o); }
int fmi2Terminate(oscillator *o) { return OK; }
int fmi2GetReal(oscillator *o, refs references, size_t n, double *values) { GET(double) }
int fmi2SetReal(oscillator *o, refs references, size_t n, const double *values) { SET }
int fmi2SetInteger(oscillator *o, refs references, size_t n, const int *values) { SET }
int fmi2SetBoolean(oscillator *o, refs references, size_t n, const int *values) { SET }
int fmi2SetString(oscillator *o, refs references, size_t n, const char *const *values) {
    return OK;
}
int fmi2DoStep(oscillator *o, double t, double h, int keep) { return step(o, t, h); }

#else

#include <stdbool.h>
#include <stdint.h>
const char *fmi3GetVersion(void) { return "3.0"; }
void *fmi3InstantiateCoSimulation(
    const char *name, const char *token, const char *where, bool visible, bool logging, bool events,
    bool early, refs wanted, size_t n, void *environment, logger3 say, void *update) {
    oscillator *o = made(token);
    if (o)
        o->say3 = say;
    return o;
}
void fmi3FreeInstance(oscillator *o) { free(o); }
int fmi3EnterInitializationMode(oscillator *o, bool a, double b, double c, bool d, double e) {
    return OK;
}
int fmi3ExitInitializationMode(oscillator *o) { return initialised(o); }
int fmi3Terminate(oscillator *o) { return OK; }
int fmi3GetFloat64(oscillator *o, refs references, size_t n, double *values, size_t m) {
    GET(double)
}
int fmi3SetFloat64(oscillator *o, refs references, size_t n, const double *values, size_t m) { SET }
int fmi3SetInt32(oscillator *o, refs references, size_t n, const int32_t *values, size_t m) { SET }
int fmi3SetBoolean(oscillator *o, refs references, size_t n, const bool *values, size_t m) { SET }
int fmi3SetString(oscillator *o, refs references, size_t n, const char *const *values, size_t m) {
    return OK;
}
int fmi3DoStep(
    oscillator *o, double t, double h, bool keep, bool *events, bool *end, bool *early,
    double *reached) {
    *events = *early = false;
    *end = o->v[FAIL_STATUS] < 0 && t >= o->v[FAIL_AT] - 1e-9;
    *reached = t + h;
    return *end ? OK : step(o, t, h);
}

#endif
