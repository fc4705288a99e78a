/* What all files share: arithmetic, memory, heaps and clocks. A library hides all names but those
   of its public headers. */
#ifndef NOACK_SHARED_H
#define NOACK_SHARED_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

#include "elementary.h"

#pragma GCC visibility push(default) /* what Python calls; all else is hidden */
#include "public.h"
#pragma GCC visibility pop

#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "datagrams and rows are little endian, and so must be the processor"
#endif

/* Functions of libm whose last bits depend on the library. */
#undef log2 /* a macro of newlib */
#pragma GCC poison exp exp2 expm1 log log2 log10 log1p pow cbrt hypot erf erfc
#pragma GCC poison sin cos tan asin acos atan atan2 sinh cosh tanh

#define NS_PER_S INT64_C(1000000000)
/* 73 years: packets that must pass may exceed a queue's size. */
#define LATEST_NS (INT64_C(1) << 61)

enum { LINE_BYTES = 64 }; /* of the processor's caches */

static inline int64_t max_of(int64_t a, int64_t b) { return a > b ? a : b; }
static inline int64_t min_of(int64_t a, int64_t b) { return a < b ? a : b; }
static inline int is_between(int64_t least, int64_t number, int64_t most) {
    return least <= number && number <= most;
}

/* Division and remainder that round towards minus infinity, as Python's do; b > 0. */
static inline int64_t floor_div(int64_t a, int64_t b) { return a / b - (a % b < 0); }
static inline int64_t floor_mod(int64_t a, int64_t b) { return a % b + (a % b < 0 ? b : 0); }

/* memory.c: zeros, or a copy, of a number of elements; NULL if there is no memory. */
void *zeros(int64_t count, size_t size);
void *copy_of(const void *elements, int64_t count, size_t size);
/* Lengthen an array, to which `array` points, by zeros; return 0 if there is no memory. */
int lengthen(void *array, int64_t before, int64_t after, size_t size);

/* An array of a structure: where its pointer is, and how many numbers of 8 bytes it has. */
enum { NEEDED, OPTIONAL, STATE }; /* one that is not given is missing, stays NULL, or is 0 */
typedef struct {
    void *pointer;
    int64_t count;
    int kind;
} owned_array;

/* Return a copy of a structure with copies of its arrays, in one piece of memory that is to be
   freed; NULL if there is no memory, or if an array is missing, which is then what is wrong. */
void *with_arrays(
    void *structure, size_t size, const owned_array *arrays, int count, const char *missing,
    const char **wrong);

/* Zeros that begin at a cache line, in memory that is to be freed. */
void *zeros_in_lines(int64_t count, size_t size, void **memory);

/* The first place in [begin, end) with a number above value; else end. The numbers ascend. */
static inline int64_t first_above(
    const int64_t *numbers, int64_t begin, int64_t end, int64_t value) {
    while (begin < end) {
        int64_t middle = begin + (end - begin) / 2;
        if (numbers[middle] <= value)
            begin = middle + 1;
        else
            end = middle;
    }
    return begin;
}

/* clock.c; live_clock.c: readings of a clock of the kernel. */
int64_t noack_simulated_ns_of(const noack_clock *clock, int64_t wall_ns);
int64_t clock_ns(int clock);
int64_t run_time_ns(const noack_clock *clock);

/* heap.c */

/* There must be room. */
void noack_heap_push(noack_heap_entry *heap, int64_t *count, noack_heap_entry entry);
/* Remove the first entry. */
void noack_heap_pop(noack_heap_entry *heap, int64_t *count);

#endif
