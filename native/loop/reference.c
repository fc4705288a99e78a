/* The reference that a loop follows: x_r(t), a solution of the model, and its input u_r(t).

   Each segment is a polynomial of the time since its begin, plus sine waves: what steps, ramps and
   sines of the outputs come to in all states and inputs (noack/scenario/references.py). */
#include <math.h>
#include <stdlib.h>

#include "loop.h"

enum { MOST_POWERS = 64, MOST_WAVES = 1 << 16 };
static const double MOST_HZ = 1e6;
static const int64_t MOST_CHANGES = INT64_C(1) << 32;

static int64_t segment_at(const noack_reference *reference, int64_t t_ns) {
    return first_above(reference->since_ns, 0, reference->changes, t_ns);
}

void noack_reference_part(
    const noack_reference *reference, int64_t segment, int64_t t_ns, int64_t first, int64_t count,
    double *result) {
    int64_t width = reference->width, powers = reference->powers, waves = reference->waves;
    const double *rows = reference->rows + segment * (powers + 2 * waves) * width + first;
    int64_t begin_ns = segment == 0 ? 0 : reference->since_ns[segment - 1];
    double elapsed_s = (double)(t_ns - begin_ns) * 1e-9;
    copy(count, rows + (powers - 1) * width, result);
    for (int64_t power = powers - 2; power >= 0; power--)
        for (int64_t k = 0; k < count; k++)
            result[k] = result[k] * elapsed_s + rows[power * width + k];
    for (int64_t wave = 0; wave < waves; wave++) {
        const double *of_sine = rows + (powers + 2 * wave) * width, *of_cosine = of_sine + width;
        wave_parts parts = sine_and_cosine(reference->hz[segment * waves + wave] * elapsed_s);
        for (int64_t k = 0; k < count; k++)
            result[k] += of_sine[k] * parts.sine + of_cosine[k] * parts.cosine;
    }
}

int64_t noack_reference_at(
    const noack_reference *reference, int64_t t_ns, int64_t first, int64_t count, double *result) {
    int64_t segment = reference == NULL ? 0 : segment_at(reference, t_ns);
    if (reference == NULL || reference->is_zero[segment])
        return 0;
    noack_reference_part(reference, segment, t_ns, first, count, result);
    return 1;
}

void noack_reference_rows(
    const noack_reference *reference, int64_t count, const int64_t *t_ns, double *result) {
    for (int64_t row = 0; row < count; row++)
        noack_reference_part(
            reference, segment_at(reference, t_ns[row]), t_ns[row], 0, reference->width,
            result + row * reference->width);
}

/* How it is made. ------------------------------------------------------------------------------ */

static const char *check(const noack_reference *reference) {
    if (!is_between(0, reference->changes, MOST_CHANGES)
        || !is_between(1, reference->powers, MOST_POWERS)
        || !is_between(0, reference->waves, MOST_WAVES)
        || !is_between(1, reference->width, 2 * NOACK_MAX_ENTRIES)
        || (reference->changes > 0 && reference->since_ns == NULL)
        || (reference->waves > 0 && reference->hz == NULL))
        return "a reference has segments, powers, waves or entries out of range, or lacks them";
    for (int64_t k = 0; k < (reference->changes + 1) * reference->waves; k++)
        if (!(fabs(reference->hz[k]) <= MOST_HZ))
            return "a wave of a reference has a frequency out of range";
    int64_t since_ns = 0;
    for (int64_t k = 0; k < reference->changes; since_ns = reference->since_ns[k++])
        if (!is_between(since_ns, reference->since_ns[k], MESSAGE_TIMES_NS))
            return "the segments of a reference are not in the order of time";
    return NULL;
}

noack_reference *noack_reference_new(const noack_reference *settings, const char **wrong) {
    noack_reference reference = *settings;
    if ((*wrong = check(&reference)) != NULL)
        return NULL;
    int64_t segments = reference.changes + 1;
    int64_t size = (reference.powers + 2 * reference.waves) * reference.width;
    reference.is_zero = NULL;
    owned_array arrays[] = {
        {&reference.since_ns, reference.changes, STATE},
        {&reference.is_zero, segments, STATE},
        {&reference.hz, segments * reference.waves, STATE},
        {&reference.rows, segments * size, NEEDED},
    };
    noack_reference *new =
        with_arrays(&reference, sizeof reference, arrays, 4, "a reference has no rows", wrong);
    for (int64_t k = 0; new != NULL && k < segments; k++) {
        new->is_zero[k] = 1;
        for (int64_t i = 0; i < size; i++)
            new->is_zero[k] &= new->rows[k * size + i] == 0.0;
    }
    return new;
}

void noack_reference_free(noack_reference *reference) { free(reference); }
