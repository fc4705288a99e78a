/* Products and norms with a fixed order of operations: a sum is formed from the left, and each
   product is rounded before it is added. */
#include <math.h>
#include <string.h>

#include "loop.h"

/* A sum of squares between these limits has neither underflowed nor overflowed. */
static const double LEAST = 1e-280, MOST = 1e280;

void noack_product(
    int64_t rows, int64_t columns, const double *matrix, const double *vector, double *result) {
    for (int64_t i = 0; i < rows; i++, matrix += columns) {
        double total = -0.0;
        for (int64_t k = 0; k < columns; k++)
            total += matrix[k] * vector[k];
        result[i] = total;
    }
}

void noack_advance_by_periods(
    int64_t n, int64_t bits, const double *powers, int64_t count, const int64_t *steps,
    double *states, double *scratch) {
    for (int64_t row = 0; row < count; row++, states += n)
        for (int64_t bit = 0; bit < bits; bit++)
            if ((uint64_t)steps[row] >> bit & 1) {
                noack_product(n, n, powers + bit * n * n, states, scratch);
                memcpy(states, scratch, (size_t)n * sizeof *states);
            }
}

void noack_multiply(
    int64_t rows, int64_t inner, int64_t columns, const double *A, const double *B, int transposed,
    double *restrict result) {
    for (int64_t i = 0; i < rows; i++, A += inner, result += columns) {
        for (int64_t j = 0; j < columns; j++)
            result[j] = -0.0;
        for (int64_t k = 0; k < inner; k++)
            for (int64_t j = 0; j < columns; j++)
                result[j] += A[k] * (transposed ? B[j * inner + k] : B[k * columns + j]);
    }
}

double noack_norm(int64_t count, const double *vector) {
    double total = 0.0;
    for (int64_t k = 0; k < count; k++)
        total += vector[k] * vector[k];
    if (LEAST < total && total < MOST)
        return sqrt(total);
    double largest = 0.0;
    for (int64_t k = 0; k < count; k++)
        if (fabs(vector[k]) > largest)
            largest = fabs(vector[k]);
    if (isinf(largest))
        return largest;
    if (largest == 0.0)
        return total; /* 0, or not a number */
    total = 0.0;
    for (int64_t k = 0; k < count; k++) {
        double scaled = vector[k] / largest;
        total += scaled * scaled;
    }
    return largest * sqrt(total);
}
