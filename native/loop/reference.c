/* The reference that a loop follows: x_r(t), a solution of the model, and its input u_r(t).

   Each segment is a polynomial of the time since its begin, plus sine waves: what steps, ramps and
   sines of the outputs come to in all states and inputs (noack/scenario/references.py). */
#include "loop.h"

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
    int64_t segment = segment_at(reference, t_ns);
    if (reference->is_zero[segment])
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
