/* The model of sensor and controller between updates: d(x - x_r)/dt = H(x - x_r), solved exactly.

   The reference x_r is the same in sensor and controller, so both models stay equal. Where it
   jumps, x does not. The same dt always gives the same matrix e^(H dt), whether it was kept or not.
 */
#include <stdlib.h>

#include "loop.h"

enum {
    WAYS = 4, /* places at which a matrix can be */
    MOST_PLACES = 1024,
    MOST_KEPT = 1 << 20, /* entries of matrices */
};

struct noack_transitions {
    int64_t n;
    int64_t is_static; /* 1: H = 0 */
    const double *H;   /* (n, n) */
    int64_t places;    /* a power of 2 */
    int64_t *steps_ns; /* (places,) dt of each place; 0: free */
    double *matrices;  /* (places, n, n) */
    double *scratch;   /* (10 n n + 3n,) */
};

int is_model(const noack_model *model, int64_t n, int64_t width) {
    return model->transitions != NULL && model->transitions->n == n
           && (model->reference == NULL || model->reference->width >= width);
}

const double *noack_transition(noack_transitions *transitions, int64_t dt_ns) {
    int64_t size = transitions->n * transitions->n, last = transitions->places - 1;
    int64_t first = (dt_ns ^ (dt_ns >> 17) ^ (dt_ns >> 31)) & last, place = first;
    for (int64_t way = 0; way < WAYS && transitions->steps_ns[place] != 0; way++) {
        if (transitions->steps_ns[place] == dt_ns)
            return transitions->matrices + place * size;
        place = (place + 1) & last;
    }
    if (transitions->steps_ns[place] != 0)
        place = first;
    double *matrix = transitions->matrices + place * size, *scaled = transitions->scratch;
    double dt_s = (double)dt_ns * 1e-9;
    for (int64_t k = 0; k < size; k++)
        scaled[k] = transitions->H[k] * dt_s;
    transitions->steps_ns[place] = dt_ns;
    noack_exponential(transitions->n, scaled, matrix, scaled + size);
    return matrix;
}

/* result = e^(H dt) x; they must not overlap. */
static void propagate(
    noack_transitions *transitions, const double *x, int64_t dt_ns, double *result) {
    int64_t n = transitions->n;
    if (dt_ns == 0 || transitions->is_static)
        copy(n, x, result);
    else
        noack_product(n, n, noack_transition(transitions, dt_ns), x, result);
}

/* Advance x about a segment of the reference; x and result may be the same. */
static void advance_about(
    const noack_model *model, int64_t segment, const double *x, int64_t from_ns, int64_t to_ns,
    double *result) {
    int64_t n = model->transitions->n;
    const noack_reference *reference = model->reference;
    double *point = model->transitions->scratch + 10 * n * n, *advanced = point + n;
    if (reference == NULL || reference->is_zero[segment] || to_ns == from_ns) {
        propagate(model->transitions, x, to_ns - from_ns, advanced);
        copy(n, advanced, result);
        return;
    }
    noack_reference_part(reference, segment, from_ns, 0, n, point);
    for (int64_t k = 0; k < n; k++)
        point[k] = x[k] - point[k];
    propagate(model->transitions, point, to_ns - from_ns, advanced);
    noack_reference_part(reference, segment, to_ns, 0, n, point);
    for (int64_t k = 0; k < n; k++)
        result[k] = point[k] + advanced[k];
}

void noack_model_advance(
    const noack_model *model, const double *x, int64_t from_ns, int64_t to_ns, double *result) {
    const noack_reference *reference = model->reference;
    int64_t changes = reference == NULL ? 0 : reference->changes;
    int64_t segment = changes == 0 ? 0 : first_above(reference->since_ns, 0, changes, from_ns);
    while (segment < changes && reference->since_ns[segment] < to_ns) {
        advance_about(model, segment, x, from_ns, reference->since_ns[segment], result);
        x = result;
        from_ns = reference->since_ns[segment++];
    }
    advance_about(model, segment, x, from_ns, to_ns, result);
}

/* How it is made. ------------------------------------------------------------------------------ */

noack_transitions *noack_transitions_new(int64_t n, const double *H, const char **wrong) {
    *wrong = is_between(1, n, NOACK_MAX_ENTRIES) ? NULL : "a model needs 1 to 64 states";
    if (*wrong != NULL)
        return NULL;
    int64_t size = n * n, places = MOST_PLACES;
    while (places > WAYS && places * size > MOST_KEPT)
        places /= 2;
    noack_transitions transitions = {.n = n, .is_static = 1, .H = H, .places = places};
    for (int64_t k = 0; H != NULL && k < size; k++)
        transitions.is_static &= H[k] == 0.0;
    owned_array arrays[] = {
        {&transitions.H, size, NEEDED},
        {&transitions.steps_ns, places, STATE},
        {&transitions.matrices, places * size, STATE},
        {&transitions.scratch, 10 * size + 3 * n, STATE},
    };
    return with_arrays(&transitions, sizeof transitions, arrays, 4, "a model has no matrix", wrong);
}

void noack_transitions_free(noack_transitions *transitions) { free(transitions); }
