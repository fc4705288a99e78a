/* The relay's time: simulated nanoseconds since its start. */
#include "relay.h"

#include <time.h>

int64_t clock_ns(int clock) {
    struct timespec now;
    clock_gettime(clock, &now);
    return (int64_t)now.tv_sec * NS_PER_S + now.tv_nsec;
}

/* The same as noack.core.clock.RunClock.now_ns. */
int64_t relay_time_ns(const noack_relay *relay) {
    return simulated_ns_of(relay, clock_ns(CLOCK_MONOTONIC) - relay->epoch_ns);
}

int64_t simulated_ns_of(const noack_relay *relay, int64_t wall_ns) {
    return relay->speed == 1.0 ? wall_ns : (int64_t)((double)wall_ns * relay->speed);
}

int64_t wall_ns_of(const noack_relay *relay, int64_t simulated_ns) {
    return relay->speed == 1.0 ? simulated_ns : (int64_t)((double)simulated_ns / relay->speed);
}
