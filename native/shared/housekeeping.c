/* When a driver returns to Python for housekeeping that is due.

   Datagrams that wait come first, as after a stall of this process. Else housekeeping waits for a
   step, and for a moment after it: the receivers of its messages come first, and the next step is
   usually a period away. It must not make a tick or a delayed datagram late. */
#include "shared.h"

enum {
    QUIET_NS = 500000, /* housekeeping in Python nearly always takes less time */
    SETTLE_NS = 200000,
    MOST_SETTLE_NS = 10000000,
    MOST_PUT_OFF_NS = 50000000 /* if something is always near, or datagrams wait */
};

int64_t noack_put_off_ns(
    noack_pauses *pauses, int64_t overdue_ns, int64_t next_ns, int64_t has_more, int64_t is_busy) {
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
