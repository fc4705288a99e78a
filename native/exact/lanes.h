/* Vectors of N numbers in the processor's registers; N is a constant of the file that includes
   this: 3, or a power of 2 from 4 on.

   Every product is added with fused rounding: x y + z is rounded once. The order of each sum is
   fixed. So results have the same bits on every processor, with instructions for vectors or without
   (then fma is libm's). A file that is built for AVX2 and FMA runs on processors that have them. */
#ifndef NOACK_EXACT_LANES_H
#define NOACK_EXACT_LANES_H

#include "exact.h"

#ifdef FUSED
#include <immintrin.h>
#endif

#ifdef FUSED
#define WIDTH 4
typedef double part __attribute__((vector_size(32)));
#else
#define WIDTH 2
typedef double part __attribute__((vector_size(16)));
#endif
enum { PARTS = (N + WIDTH - 1) / WIDTH, STRIDE = WIDTH * PARTS };

typedef struct {
    part part[PARTS];
} lanes; /* entries from N on have no meaning */

static inline part fused(part a, part b, part c) {
#ifdef FUSED
    return _mm256_fmadd_pd(a, b, c);
#else
    for (int i = 0; i < WIDTH; i++)
        c[i] = __builtin_fma(a[i], b[i], c[i]);
    return c;
#endif
}

static inline part spread(double number) { return number - (part){0.0}; }

static inline lanes load(const double *numbers) {
    lanes v;
    for (int i = 0; i < PARTS; i++)
        memcpy(&v.part[i], numbers + i * WIDTH, sizeof v.part[i]);
    return v;
}

static inline void store(double *numbers, lanes v) {
    for (int i = 0; i < PARTS; i++)
        memcpy(numbers + i * WIDTH, &v.part[i], sizeof v.part[i]);
}

static inline lanes filled(double number) {
    lanes v;
    for (int i = 0; i < PARTS; i++)
        v.part[i] = spread(number);
    return v;
}

static inline lanes add(lanes v, lanes w) {
    for (int i = 0; i < PARTS; i++)
        v.part[i] = v.part[i] + w.part[i];
    return v;
}

static inline lanes subtract(lanes v, lanes w) {
    for (int i = 0; i < PARTS; i++)
        v.part[i] = v.part[i] - w.part[i];
    return v;
}

static inline lanes multiply(lanes v, lanes w) {
    for (int i = 0; i < PARTS; i++)
        v.part[i] = v.part[i] * w.part[i];
    return v;
}

static inline lanes scale(lanes v, double factor) {
    for (int i = 0; i < PARTS; i++)
        v.part[i] = v.part[i] * spread(factor);
    return v;
}

/* v w + z */
static inline lanes fma_lanes(lanes v, lanes w, lanes z) {
    for (int i = 0; i < PARTS; i++)
        v.part[i] = fused(v.part[i], w.part[i], z.part[i]);
    return v;
}

/* v s + z */
static inline lanes fma_scaled(lanes v, double s, lanes z) {
    for (int i = 0; i < PARTS; i++)
        v.part[i] = fused(v.part[i], spread(s), z.part[i]);
    return v;
}

static inline lanes magnitude(lanes v) {
#ifdef FUSED
    for (int i = 0; i < PARTS; i++)
        v.part[i] = _mm256_andnot_pd(_mm256_set1_pd(-0.0), v.part[i]);
#else
    for (int i = 0; i < STRIDE; i++)
        v.part[i / WIDTH][i % WIDTH] = fabs(v.part[i / WIDTH][i % WIDTH]);
#endif
    return v;
}

static inline double entry(lanes v, int i) { return v.part[i / WIDTH][i % WIDTH]; }

/* Matrix times vector; the matrix has N columns of STRIDE numbers each. */
static inline __attribute__((always_inline)) lanes times(const double *matrix, lanes v) {
    lanes total = scale(load(matrix), entry(v, 0));
#pragma GCC unroll 8
    for (int j = 1; j < N; j++)
        total = fma_scaled(load(matrix + j * STRIDE), entry(v, j), total);
    return total;
}

/* W v; without W, v. */
static inline lanes weigh(const double *weight, lanes v) {
    return weight == NULL ? v : times(weight, v);
}

/* The sum of the entries: halves are added to each other. */
static inline double sum(lanes v) {
#if N == 3
    return (entry(v, 0) + entry(v, 1)) + entry(v, 2);
#else
    for (int parts = PARTS / 2; parts > 0; parts /= 2)
        for (int i = 0; i < parts; i++)
            v.part[i] = v.part[i] + v.part[i + parts];
#if WIDTH == 2
    return entry(v, 0) + entry(v, 1);
#else
    return (entry(v, 0) + entry(v, 2)) + (entry(v, 1) + entry(v, 3));
#endif
#endif
}

static inline double dot(lanes v, lanes w) { return sum(multiply(v, w)); }

#endif
