/* The clock of a run: simulated time as a function of this host's monotonic clock. */
#include "core.h"

#include <math.h>

enum { PPB = 1000000000 };

/* The offset of the coordinator's clock, as SlewedClock (noack/runtime/host_clocks) applies it. */
static int64_t applied_offset_ns(const noack_clock *clock, int64_t own_ns) {
    int64_t since_ns = own_ns - clock->since_ns;
    /* The product of both numbers may exceed 64 bits. */
    int64_t most_ns = clock->slew_ppb * floor_div(since_ns, PPB)
                      + floor_div(clock->slew_ppb * floor_mod(since_ns, PPB), PPB);
    int64_t change_ns = clock->target_offset_ns - clock->first_offset_ns;
    return clock->first_offset_ns + min_of(max_of(change_ns, -most_ns), most_ns);
}

int64_t noack_clock_at_ns(const noack_clock *clock, int64_t own_ns) {
    int64_t wall_ns = own_ns - clock->epoch_ns;
    if (clock->slew_ppb > 0)
        wall_ns += applied_offset_ns(clock, own_ns);
    return noack_simulated_ns_of(clock, wall_ns);
}

/* Truncate to a whole number, of 146 years at most. */
static int64_t whole_ns(double time_ns) {
    const double most = 4611686018427387904.0; /* 2^62 */
    return (int64_t)fmin(fmax(time_ns, -most), most);
}

int64_t noack_simulated_ns_of(const noack_clock *clock, int64_t wall_ns) {
    return clock->speed == 1.0 ? wall_ns : whole_ns((double)wall_ns * clock->speed);
}

int64_t noack_clock_wait_ns(const noack_clock *clock, int64_t simulated_ns) {
    double fastest = 1.0 + (double)clock->slew_ppb / (double)PPB, speed = clock->speed * fastest;
    if (speed == 1.0 || simulated_ns <= 0)
        return simulated_ns;
    return whole_ns((double)simulated_ns / speed);
}
