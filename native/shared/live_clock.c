/* Readings of the kernel's clocks: of live runs, and of the relay. */
#define _GNU_SOURCE
#include <time.h>

#include "shared.h"

int64_t clock_ns(int clock) {
    struct timespec now;
    clock_gettime(clock, &now);
    return (int64_t)now.tv_sec * NS_PER_S + now.tv_nsec;
}

int64_t run_time_ns(const noack_clock *clock) {
    return noack_clock_at_ns(clock, clock_ns(CLOCK_MONOTONIC));
}
