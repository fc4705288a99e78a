/* The live driver: messages and ticks of the machines of a process, in real time. Its sockets are
   in sockets.c. */
#include "driver.h"

#include <errno.h>
#include <sched.h>
#include <stdlib.h>
#include <sys/epoll.h>
#include <sys/syscall.h>
#include <sys/timerfd.h>
#include <time.h>
#include <unistd.h>

enum {
    TICKS = 64,          /* that are done before it receives again */
    MANY_BYTES = 393216, /* of rows: a thousand loops at 50 Hz write fewer until housekeeping */
    EARLY_NS = 1000      /* a timer may expire so much before its time */
};

noack_driver *noack_driver_new(
    noack_process *process, const noack_wire *wire, int64_t spin_ns, int64_t coalescing_ns,
    const char **wrong) {
    int is_valid = spin_ns >= 0 && is_between(0, coalescing_ns, NS_PER_S - 1);
    *wrong = is_valid ? NULL : "spin_ns and coalescing_ns must be from 0 to less than 1 s";
    noack_driver *driver = is_valid ? zeros(1, sizeof *driver) : NULL;
    if (driver == NULL)
        return NULL;
    driver->process = process;
    driver->wire = *wire;
    driver->clock.speed = 1.0;
    driver->spin_ns = spin_ns;
    driver->coalescing_ns = coalescing_ns;
    driver->scratch = zeros_in_lines(1, sizeof *driver->scratch, &driver->scratch_memory);
    if (driver->scratch != NULL)
        return driver;
    noack_driver_free(driver);
    return NULL;
}

void noack_driver_free(noack_driver *driver) {
    if (driver != NULL)
        free(driver->scratch_memory);
    free(driver);
}

/* Write the datagram of the message that a machine sends, without its tag, if it sends one. There
   must be room. */
static void put_output(noack_driver *driver) {
    driver_scratch *scratch = scratch_of(driver);
    const noack_output *output = &driver->process->output;
    scratch->pauses.worked_since_wait = 1;
    if (!output->sends)
        return;
    int64_t place = scratch->out_count++;
    scratch->out_flows[place] = output->message.flow == NOACK_ACKNOWLEDGEMENT;
    scratch->out_vectors[place].iov_len =
        (size_t)write_content(&driver->wire, &output->message, scratch->out_data[place])
        + NOACK_TAG_BYTES;
}

/* Show Python the datagram that it opens or seals. */
static void point_to(noack_driver *driver, uint8_t *datagram, int64_t size_bytes) {
    driver->datagram = datagram;
    driver->datagram_bytes = size_bytes;
}

/* Whether the next datagram to send must be encrypted. */
static int must_seal(noack_driver *driver) {
    driver_scratch *scratch = scratch_of(driver);
    scratch->is_sealing = driver->wire.encrypted && scratch->sealed_count < scratch->out_count;
    if (scratch->is_sealing) {
        int64_t place = scratch->sealed_count++;
        point_to(driver, scratch->out_data[place], (int64_t)scratch->out_vectors[place].iov_len);
    }
    return scratch->is_sealing != 0;
}

/* Why the driver returns for a step that was not done. */
static int64_t reason_of(int64_t question) {
    return question == NOACK_ROWS_FULL ? NOACK_DRIVER_ROWS : NOACK_DRIVER_FAILED;
}

/* Let the processor fetch the machine to which a datagram that was received goes. */
static void fetch_machine_of(const noack_driver *driver, int64_t place) {
    const arrival *next = &scratch_of(driver)->arrivals[place];
    if (place < scratch_of(driver)->in_end)
        fetch_machine(driver->process, max_of(header_loop(next->data, next->size_bytes), 0));
}

/* Examine the current datagram; return NOACK_DRIVER_OPEN if it must be opened. */
static int64_t examine(noack_driver *driver) {
    driver_scratch *scratch = scratch_of(driver);
    const arrival *current = &scratch->arrivals[scratch->in_next];
    uint8_t *datagram = current->data;
    int64_t size_bytes = current->size_bytes;
    int64_t loop = header_loop(datagram, size_bytes);
    fetch_machine_of(driver, scratch->in_next + 1);
    int is_answer = driver->sources[1].name_bytes > 0
                    && header_flow(datagram, size_bytes) == NOACK_ACKNOWLEDGEMENT;
    if (loop >= driver->process->loops) /* rejected by the first loop */
        loop = 0;
    noack_machine *machine = noack_process_machine(driver->process, max_of(loop, 0));
    noack_reception *reception = is_answer ? &machine->acknowledgements : &machine->received;
    scratch->now_ns = run_time_ns(&driver->clock);
    int64_t examination = NOACK_BAD_TAG;
    if (driver->opened != NOACK_NOT_AUTHENTIC)
        examination = noack_wire_examine(
            &driver->wire, reception, max_of(loop, 0), datagram, size_bytes,
            is_peer(current->name, &driver->sources[is_answer]),
            current->has_tag ? NOACK_OPENED : driver->opened, &scratch->message);
    if (examination == NOACK_ENCRYPTED)
        return NOACK_DRIVER_OPEN;
    driver->opened = NOACK_NOT_OPENED;
    noack_wire_count(reception, examination, &scratch->message);
    scratch->is_accepted = examination == NOACK_ACCEPTED;
    return NOACK_DRIVER_NOTHING;
}

/* Whether to look at the time and the sockets after a step: Python's answer may have taken long. */
static int has_asked(noack_driver *driver) {
    int asked = driver->process->has_asked != 0;
    driver->process->has_asked = 0;
    return asked;
}

/* Handle the datagrams received, up to one that Python was asked about. */
static int64_t handle_messages(noack_driver *driver) {
    driver_scratch *scratch = scratch_of(driver);
    while (scratch->in_next < scratch->in_end && scratch->out_count < BUFFERS) {
        if (!scratch->is_accepted && examine(driver) == NOACK_DRIVER_OPEN)
            return NOACK_DRIVER_OPEN;
        if (scratch->is_accepted) {
            int64_t question =
                noack_process_handle(driver->process, &scratch->message, scratch->now_ns);
            if (question != NOACK_DONE)
                return reason_of(question);
            put_output(driver);
        }
        scratch->is_accepted = 0;
        scratch->in_next++;
        if (has_asked(driver))
            break;
    }
    return NOACK_DRIVER_NOTHING;
}

/* Do ticks that are due, up to one that Python was asked about. */
static int64_t do_ticks(noack_driver *driver) {
    driver_scratch *scratch = scratch_of(driver);
    for (int count = 0; count < TICKS && scratch->out_count < BUFFERS; count++) {
        if (!scratch->is_ticking) {
            int64_t due_ns = noack_process_due_ns(driver->process);
            if (due_ns == INT64_MAX)
                break;
            scratch->now_ns = run_time_ns(&driver->clock);
            if (scratch->now_ns < due_ns)
                break;
            scratch->is_ticking = 1;
        }
        int64_t question = noack_process_tick(driver->process, scratch->now_ns);
        if (question != NOACK_DONE)
            return reason_of(question);
        scratch->is_ticking = 0;
        put_output(driver);
        if (has_asked(driver))
            break;
    }
    return NOACK_DRIVER_NOTHING;
}

static int64_t do_steps(noack_driver *driver) {
    int64_t reason = NOACK_DRIVER_NOTHING;
    if (!scratch_of(driver)->is_ticking)
        reason = handle_messages(driver);
    return reason == NOACK_DRIVER_NOTHING ? do_ticks(driver) : reason;
}

/* Wall time until the next tick, or a little less; INT64_MAX: there is none. */
static int64_t next_tick_ns(const noack_driver *driver, int64_t now_ns) {
    int64_t due_ns = noack_process_due_ns(driver->process);
    return due_ns == INT64_MAX ? INT64_MAX : noack_clock_wait_ns(&driver->clock, due_ns - now_ns);
}

/* Let the timer expire at a time of the monotonic clock, or a little before.

   It is not cancelled if a datagram comes first, as the timeout of ppoll would be: cancelling the
   next timer of a core takes microseconds in a virtual machine. */
static void set_timer(noack_driver *driver, int64_t wall_ns, int64_t at_ns) {
    driver_scratch *scratch = scratch_of(driver);
    if (wall_ns < scratch->timer_ns && scratch->timer_ns <= at_ns
        && at_ns - scratch->timer_ns < EARLY_NS)
        return;
    struct itimerspec at = {.it_value = {at_ns / NS_PER_S, at_ns % NS_PER_S}};
    timerfd_settime((int)driver->timer, TFD_TIMER_ABSTIME, &at, NULL);
    scratch->timer_ns = at_ns;
}

/* Sleep until a socket has datagrams, a tick is near, or for wait_ns from wall_ns on. Return the
   sockets to read as bits, or -1 if a signal interrupted it. */
static int64_t sleep_until_needed(
    noack_driver *driver, int64_t wall_ns, int64_t tick_ns, int64_t wait_ns) {
    driver_scratch *scratch = scratch_of(driver);
    int coalesces = scratch->pauses.worked_since_wait && !scratch->has_more && 0 < tick_ns
                    && tick_ns < driver->coalescing_ns;
    scratch->pauses.worked_since_wait = 0;
    if (coalesces) {
        struct timespec pause = {0, driver->coalescing_ns};
        return clock_nanosleep(CLOCK_MONOTONIC, 0, &pause, NULL) == EINTR
                   ? -1
                   : (INT64_C(1) << driver->receiver_count) - 1;
    }
    if (tick_ns != INT64_MAX)
        wait_ns = min_of(wait_ns, tick_ns - driver->spin_ns);
    if (wait_ns > 0)
        set_timer(driver, wall_ns, wall_ns + wait_ns);
    struct epoll_event events[3]; /* of both sockets and the timer */
    int count = epoll_wait((int)driver->epoll, events, 3, wait_ns > 0 ? -1 : 0);
    if (count < 0)
        return errno == EINTR ? -1 : 0;
    uint64_t ready = 0;
    for (int k = 0; k < count; k++)
        ready |= events[k].data.u64;
    return (int64_t)ready;
}

/* How long to wait for, at most, or 0 if the time for housekeeping has come. */
static int64_t wait_for_ns(
    noack_driver *driver, int64_t until_ns, int64_t now_ns, int64_t tick_ns) {
    if (now_ns < until_ns)
        return max_of(noack_clock_wait_ns(&driver->clock, until_ns - now_ns), 1);
    if (until_ns == INT64_MIN) /* what has been received is still to be handled */
        return 1;
    if (driver->coalescing_ns > 0) /* no moment is better than another */
        return 0;
    int64_t overdue_ns = noack_clock_wait_ns(&driver->clock, now_ns - until_ns);
    return noack_put_off_ns(&scratch_of(driver)->pauses, overdue_ns, tick_ns, 0, 0);
}

/* Whether Python should take a table's rows before the next steps: taking few at a time keeps it
   for a short time only. */
static int has_many_rows(const noack_process *process) {
    for (int k = 0; k < NOACK_TABLES; k++)
        if (process->tables[k].count * process->tables[k].row_bytes >= MANY_BYTES)
            return 1;
    return 0;
}

int64_t noack_drive(noack_driver *driver, int64_t until_ns) {
    driver_scratch *scratch = scratch_of(driver);
    for (;;) {
        if (!scratch->is_sealing)
            scratch->reason = do_steps(driver);
        if (must_seal(driver))
            return NOACK_DRIVER_SEAL;
        if (scratch->out_count > 0 && !driver->wire.encrypted)
            write_tags(driver);
        if (scratch->out_count > 0)
            send_datagrams(driver);
        if (scratch->reason == NOACK_DRIVER_OPEN)
            point_to(
                driver, scratch->arrivals[scratch->in_next].data,
                scratch->arrivals[scratch->in_next].size_bytes);
        if (scratch->reason != NOACK_DRIVER_NOTHING)
            return scratch->reason;
        if (scratch->in_next == scratch->in_end && scratch->message_next < scratch->message_end)
            take_datagrams(driver);
        if (until_ns == INT64_MIN && scratch->in_next == scratch->in_end)
            return NOACK_DRIVEN;
        if (has_many_rows(driver->process))
            return NOACK_DRIVER_ROWS;
        int64_t wall_ns = clock_ns(CLOCK_MONOTONIC);
        int64_t now_ns = noack_clock_at_ns(&driver->clock, wall_ns);
        int64_t tick_ns = next_tick_ns(driver, now_ns);
        int64_t wait_ns = wait_for_ns(driver, until_ns, now_ns, tick_ns);
        if (wait_ns == 0)
            return NOACK_DRIVEN;
        if (scratch->in_next < scratch->in_end)
            continue;
        int64_t ready = sleep_until_needed(driver, wall_ns, tick_ns, wait_ns);
        if (ready < 0)
            return NOACK_DRIVEN;
        if (ready > 0)
            receive_datagrams(driver, ready);
    }
}

void noack_prefer_others(void) {
    struct { /* sched_attr of Linux */
        uint32_t size, policy;
        uint64_t flags;
        int32_t nice;
        uint32_t priority;
        uint64_t runtime_ns, deadline_ns, period_ns;
    } attributes = {.size = 48, .policy = SCHED_OTHER, .runtime_ns = 100000000};
    syscall(SYS_sched_setattr, 0, &attributes, 0);
}
