/* What the steps of a loop's machines share. */
#ifndef NOACK_LOOP_H
#define NOACK_LOOP_H

#include <string.h>

#include "../network/network.h"

#pragma GCC visibility push(default)
#include "public.h"
#pragma GCC visibility pop

enum { MOST_LOOPS = 65535 }; /* of a run: datagrams have the number of the loop in 16 bits */

#define NO_TICK INT64_MAX
#define MESSAGE_TIMES_NS (INT64_C(1) << 62) /* times of messages are below; see wire.c */

static inline void copy(int64_t count, const double *source, double *result) {
    memcpy(result, source, (size_t)count * sizeof *result);
}

/* The row of an output: integers, and the bits of doubles. */
static inline void put(noack_output *output, int64_t number) {
    output->row[output->words++] = number;
}

static inline void put_reals(noack_output *output, int64_t count, const double *values) {
    memcpy(output->row + output->words, values, (size_t)count * sizeof *values);
    output->words += count;
}

/* Begin a row with the columns that all tables have. */
static inline void begin_row(
    noack_output *output, int64_t table, noack_machine *machine, int64_t sequence, int64_t t_ns,
    int64_t now_ns) {
    output->sends = output->notes = output->words = 0;
    output->table = table;
    put(output, machine->inputs++);
    put(output, sequence);
    put(output, t_ns);
    put(output, now_ns);
}

/* Begin the message of an output; its vector is still empty. */
static inline void begin_message(
    noack_output *output, int64_t flow, int64_t sequence, int64_t t_ns) {
    output->sends = 1;
    output->message.flow = flow;
    output->message.sequence = sequence;
    output->message.t_ns = t_ns;
    output->message.entries = output->message.error_level = 0;
}

static inline void append(noack_output *output, int64_t count, const double *values) {
    copy(count, values, output->message.vector + output->message.entries);
    output->message.entries += count;
}

/* Times and numbers of which a few sums, with the time of a message, fit into an int64_t. */
#define MOST_NS (INT64_C(1) << 60)
#define MOST_NUMBER (INT64_MAX / 2)

/* Limits of lengths, within which their products fit, too. */
enum { MOST_EVERY = 1 << 20, MOST_ROWS = 1 << 16, MOST_PARTS = 100000 };

/* Whether a period has at least some whole nanoseconds; its multiples do not overflow. */
static inline int is_period(const noack_period *period, int64_t least_ns) {
    return is_between(least_ns, period->ns, MOST_NS) && is_between(1, period->parts, MOST_PARTS)
           && is_between(0, period->part, period->parts - 1)
           && (period->part == 0 || period->parts <= period->ns);
}

/* process.c: begin a new machine, which receives this flow; return NULL, or what is wrong. */
const char *begin_machine(noack_machine *machine, int64_t flow);

/* model.c: whether a model has n states, and a reference of at least this width. */
int is_model(const noack_model *model, int64_t n, int64_t width);

/* Let Python do what a step needs; return whether it did. */
static inline int ask(const noack_machine *machine, int64_t question) {
    return machine->ask(machine->loop, question) == 0;
}

/* The nearest whole number of nanoseconds to k periods, halves up; k >= 0. */
static inline int64_t periods_ns(const noack_period *period, int64_t k) {
    return k * period->ns + (2 * k * period->part + period->parts) / (2 * period->parts);
}

/* The same, rounded down: a time that is not before is reached at the tick k after any tick. */
static inline int64_t whole_periods_ns(const noack_period *period, int64_t k) {
    return k * period->ns + k * period->part / period->parts;
}

/* The largest k of which whole_periods_ns is at most an age, which is not negative. */
static inline int64_t periods_within(const noack_period *period, int64_t age_ns) {
    int64_t k = age_ns / period->ns;
    if (period->part == 0)
        return k;
    k = max_of(k - k / period->ns - 1, 0); /* each period is less than 1 ns longer */
    while (whole_periods_ns(period, k + 1) <= age_ns)
        k++;
    return k;
}

/* The time of tick k of a machine. */
static inline int64_t time_of_tick_ns(const noack_machine *machine, int64_t k) {
    return machine->first_ns + periods_ns(&machine->period, k);
}

/* The time between the last tick of a machine and its next one, which is not the first. */
static inline int64_t last_period_ns(const noack_machine *machine) {
    return time_of_tick_ns(machine, machine->step) - time_of_tick_ns(machine, machine->step - 1);
}

/* The time of the next tick of a machine; NO_TICK: there is none. */
static inline int64_t tick_ns(const noack_machine *machine) {
    if (machine->period.ns == 0)
        return NO_TICK;
    int64_t t_ns = time_of_tick_ns(machine, machine->step);
    return t_ns <= machine->horizon_ns ? t_ns : NO_TICK;
}

/* result = A B, or A B' if transposed; A is (rows, inner), result (rows, columns). They must not
   overlap. */
void noack_multiply(
    int64_t rows, int64_t inner, int64_t columns, const double *A, const double *B, int transposed,
    double *result);

/* The norm of M v; M is (rows, columns). image: (rows,) */
static inline double image_norm(
    int64_t rows, int64_t columns, const double *matrix, const double *vector, double *image) {
    noack_product(rows, columns, matrix, vector, image);
    return noack_norm(rows, image);
}

/* process.c: a step of the machine of a loop, at a time of the loop; only plants and controllers
   have ticks. */
int64_t noack_handle_message(
    noack_process *process, int64_t loop, const noack_message *message, int64_t now_ns);
int64_t noack_do_tick(noack_process *process, int64_t loop, int64_t now_ns);

/* plant.c: set the input of the system for a step: u + d, and w behind it. */
void noack_disturb(noack_plant *plant, int64_t step);

/* observer.c: advance x-hat to a measurement [y; u of the plant's steps since the last one]. */
void noack_observe(
    noack_observer *observer, const noack_message *message, const noack_period *plant_period);

/* process.c: let the processor fetch the memory of a machine, which is needed soon. Without it
   the step of one of a thousand loops waits for it. */
void fetch_machine(const noack_process *process, int64_t loop);

/* Copy what a message has: it may have few entries. */
static inline void copy_message(noack_message *to, const noack_message *from) {
    memcpy(to, from, offsetof(noack_message, vector) + (size_t)from->entries * sizeof(double));
}

/* wire.c: a message's datagram without its tag, of which the size is returned; its tag;
   and whether bytes that were received are a tag. */
int64_t write_content(const noack_wire *wire, const noack_message *message, uint8_t *datagram);
void write_tag(const noack_wire *wire, int64_t content_bytes, uint8_t *datagram);
int is_tag(const uint64_t tag[NOACK_TAG_BYTES / 8], const uint8_t *bytes);

/* wire.c: the header of a message's datagram; and the tests of an authentic datagram. */
void noack_wire_header(const noack_wire *wire, const noack_message *message, uint8_t *header);
int64_t noack_wire_examine_message(
    const noack_reception *reception, int64_t from_peer, const noack_message *message);

#endif
