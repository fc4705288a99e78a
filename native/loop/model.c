/* The model of sensor and controller between updates: dx/dt = H(x - x_r), solved exactly.

   The set point x_r changes at the same times in sensor and controller, so both models stay equal.
   The same dt always gives the same matrix e^(H dt), whether it was kept or not. */
#include "loop.h"

enum { WAYS = 4 }; /* places at which a matrix can be */

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

/* Advance x about a set point; x and result may be the same. */
static void advance_about(
    const noack_model *model, int64_t place, const double *x, int64_t dt_ns, double *result) {
    int64_t n = model->transitions->n;
    double *from_point = model->transitions->scratch + 10 * n * n, *advanced = from_point + n;
    if (!model->has_point[place] || dt_ns == 0) {
        propagate(model->transitions, x, dt_ns, advanced);
        copy(n, advanced, result);
        return;
    }
    const double *point = model->points + place * n;
    for (int64_t k = 0; k < n; k++)
        from_point[k] = x[k] - point[k];
    propagate(model->transitions, from_point, dt_ns, advanced);
    for (int64_t k = 0; k < n; k++)
        result[k] = point[k] + advanced[k];
}

const double *noack_model_point(const noack_model *model, int64_t t_ns) {
    int64_t place = first_above(model->since_ns, 0, model->changes, t_ns);
    return model->has_point[place] ? model->points + place * model->transitions->n : NULL;
}

void noack_model_advance(
    const noack_model *model, const double *x, int64_t from_ns, int64_t to_ns, double *result) {
    int64_t place = first_above(model->since_ns, 0, model->changes, from_ns);
    while (place < model->changes && model->since_ns[place] < to_ns) {
        advance_about(model, place, x, model->since_ns[place] - from_ns, result);
        x = result;
        from_ns = model->since_ns[place++];
    }
    advance_about(model, place, x, to_ns - from_ns, result);
}
