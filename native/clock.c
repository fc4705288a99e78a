/* The clock of a run: simulated time as a function of this host's monotonic clock. */
#include "core.h"

#include <math.h>

enum {
    PPB = 1000000000,
    QUIET_NS = 500000, /* housekeeping in Python nearly always takes less time */
    SETTLE_NS = 200000,
    MOST_SETTLE_NS = 10000000,
    MOST_PUT_OFF_NS = 50000000 /* if something is always near, or datagrams wait */
};

/* The offset of the coordinator's clock, as SlewedClock (noack/runtime/host_clocks) applies it. */
static int64_t applied_offset_ns(const noack_clock *clock, int64_t own_ns) {
    int64_t since_ns = own_ns - clock->since_ns;
    /* The product of both numbers may exceed 64 bits. */
    int64_t most_ns = clock->slew_ppb * floor_div(since_ns, PPB)
                      + floor_div(clock->slew_ppb * floor_mod(since_ns, PPB), PPB);
    int64_t change_ns = clock->target_ns - clock->begun_ns;
    return clock->begun_ns + min_of(max_of(change_ns, -most_ns), most_ns);
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

/* Datagrams that wait come first, as after a stall of this process. Else housekeeping waits for a
   step, and for a moment after it: the receivers of its messages come first, and the next step is
   usually a period away. It must not make a tick or a delayed datagram late. */
int64_t noack_put_off_ns(
    pauses *pauses, int64_t overdue_ns, int64_t next_ns, int has_more, int is_busy) {
    int64_t left_ns = MOST_PUT_OFF_NS - overdue_ns;
    pauses->worked_since_due |= pauses->worked_since_wait;
    int settled = is_busy || overdue_ns >= MOST_SETTLE_NS
                  || (pauses->worked_since_due && !pauses->worked_since_wait);
    if (left_ns <= 0 || (settled && !has_more && next_ns > QUIET_NS)) {
        pauses->worked_since_due = 0;
        return 0;
    }
    if (has_more)
        return left_ns;
    return pauses->worked_since_due || settled ? SETTLE_NS : MOST_SETTLE_NS - overdue_ns;
}
