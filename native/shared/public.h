/* What Python uses of numbers and clocks; each room has its own public.h.

   native/build.py gives these files to cffi, and netem/core/core_library.py makes numpy's row types
   of them. Therefore they have declarations, enumerations and comments only;
   every number is a double or an integer of a stated width. Times are integer nanoseconds. What
   noack_..._new returns owns its memory, until noack_..._free. Machines, link and simulators call no
   clock and no socket; the driver and the relay do.

   The comment of a field stands beside it, a long one above it. A blank line begins a group of
   fields, whose heading may follow. */

/* ---- Functions with the same bits on every processor ----------------------------------------- */

/* e^x, e^x - 1, ln x, and the cube root of x >= 0. See elementary.h. */
double noack_exp(double x);
double noack_expm1(double x);
double noack_log(double x);
double noack_cube_root(double x);

/* Sine and cosine of 2 pi times a number of turns below 2^50. */
void noack_sine_and_cosine(double turns, double sine_and_cosine[2]);

/* ---- The clock of a run, and what its sockets need ------------------------------------------- */

enum {
    NOACK_NAME_BYTES = 40, /* room for a socket address (IPv6: 28 bytes), or a 5-tuple */
    NOACK_ERRNOS = 256
};

/* The clock of a run, as netem.core.clock: simulated time since the run's epoch. */
typedef struct {
    int64_t epoch_ns; /* reading of this host's monotonic clock at simulated time 0 */
    double speed;     /* simulated time per time of that clock */
} noack_clock;

/* The simulated time at a reading of this host's monotonic clock. */
int64_t noack_clock_at_ns(const noack_clock *clock, int64_t own_ns);

/* How long to wait on this host until simulated_ns has passed. */
int64_t noack_clock_wait_ns(const noack_clock *clock, int64_t simulated_ns);

typedef struct { /* of a driver that returns to Python for housekeeping */
    int64_t worked_since_wait; /* 1: it has worked since it last waited */
    int64_t worked_since_due;  /* 1: it has worked since housekeeping became due */
} noack_pauses;

/* How long to put off housekeeping that has been due for a time; 0: not at all. next_ns: the time
   until the next tick or departure. has_more: datagrams wait. is_busy: no pause is to be expected.
   All times are wall time. */
int64_t noack_put_off_ns(
    noack_pauses *pauses, int64_t overdue_ns, int64_t next_ns, int64_t has_more, int64_t is_busy);

/* An entry of a heap, by (due_ns, number): a delayed datagram, or the next tick of the loop of this
   number. */
typedef struct {
    int64_t due_ns, number;
    int64_t slot; /* of the datagram */
} noack_heap_entry;
