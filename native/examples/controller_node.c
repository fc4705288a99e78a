/* A controller of noack without Python: the core's steps, and what a board has to provide, here by
   POSIX: a UDP socket in each direction, a monotonic clock, and a stream to noack (docs/node.md).

   It sends the version of the settings, reads them with its sockets, and works until its standard
   input ends. Its memory is fixed. Nothing here computes: that is in ../loop and ../wire.c. */
#define _GNU_SOURCE
#include <errno.h>
#include <poll.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include "../noack.h"

enum {
    STATES = 16, /* most that it has room for */
    INPUTS = 16,
    PLACES = 64, /* matrices e^(H dt) that it keeps; any power of 2 from 4 on gives the same bits */
    AT_ONCE = 16, /* datagrams, or ticks, between two looks at everything else */
    PENDING_BYTES = 1 << 18
};
#define NS_PER_S INT64_C(1000000000)
#define REPORT_NS (NS_PER_S / 20)

static noack_node_settings settings;
static noack_node_counts counts;
static noack_controller controller;
static noack_transitions transitions;
static noack_machine *const machine = &controller.machine;
static noack_wire wire;
static noack_output output;
static int sockets[3]; /* connected: it receives updates; sends actuations; acknowledgements */
static struct sockaddr_storage peer;

static double numbers[STATES * STATES * (PLACES + 12) + STATES * (INPUTS + 16) + 8 * INPUTS];
static int64_t numbers_used, steps_ns[PLACES], no_change;
static uint8_t pending[PENDING_BYTES]; /* for noack, which may be slow */
static size_t pending_bytes;

static void fail(const char *what) {
    fprintf(stderr, "controller_node: %s\n", what);
    exit(1);
}

static int64_t wall_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * NS_PER_S + now.tv_nsec;
}

/* ---- The stream to noack ---- */

static void flush(int flags) {
    ssize_t sent = send(STDOUT_FILENO, pending, pending_bytes, MSG_NOSIGNAL | flags);
    if (sent < 0 && errno != EAGAIN && errno != EINTR)
        exit(0); /* noack has closed the stream */
    sent = sent > 0 ? sent : 0;
    pending_bytes -= (size_t)sent;
    memmove(pending, pending + sent, pending_bytes);
}

static void put(const void *content, int64_t bytes) {
    while (pending_bytes + (size_t)bytes > PENDING_BYTES)
        flush(0);
    memcpy(pending + pending_bytes, content, (size_t)bytes);
    pending_bytes += (size_t)bytes;
}

static void put_frame(int64_t kind, const void *content, int64_t bytes) {
    put((int64_t[2]){kind, bytes}, 16);
    put(content, bytes);
}

static void put_counts(void) {
    counts.accepted = machine->received.accepted;
    memcpy(counts.rejected, machine->received.rejected, sizeof counts.rejected);
    put_frame(NOACK_NODE_COUNTS, &counts, sizeof counts);
}

/* Read all bytes; at the end of the stream, the run has ended. */
static void read_exactly(void *content, int64_t bytes) {
    for (uint8_t *place = content; bytes > 0;) {
        ssize_t received = read(STDIN_FILENO, place, (size_t)bytes);
        if (received == 0) {
            put_counts();
            while (pending_bytes > 0)
                flush(0);
            exit(0);
        }
        if (received < 0 && errno != EINTR)
            fail(strerror(errno));
        place += received < 0 ? 0 : received;
        bytes -= received < 0 ? 0 : received;
    }
}

/* ---- The settings ---- */

static double *allocate(int64_t count) {
    double *place = numbers + numbers_used;
    numbers_used += count;
    return place;
}

static double *read_reals(int64_t count) {
    double *place = allocate(count);
    read_exactly(place, count * 8);
    return place;
}

/* The sockets come with the first byte of the stream. */
static void read_sockets(void) {
    _Alignas(struct cmsghdr) uint8_t control[CMSG_SPACE(sizeof sockets)];
    uint8_t head[16];
    struct iovec vector = {head, 1};
    struct msghdr message = {.msg_iov = &vector, .msg_iovlen = 1};
    message.msg_control = control;
    message.msg_controllen = sizeof control;
    socklen_t peer_bytes = sizeof peer;
    ssize_t received = recvmsg(STDIN_FILENO, &message, 0);
    if (received == 0)
        exit(0); /* the run never began */
    struct cmsghdr *first = received > 0 ? CMSG_FIRSTHDR(&message) : NULL;
    if (first == NULL || first->cmsg_len != CMSG_LEN(sizeof sockets))
        fail("it is started by noack, see docs/node.md");
    memcpy(sockets, CMSG_DATA(first), sizeof sockets);
    getpeername(sockets[0], (struct sockaddr *)&peer, &peer_bytes);
    read_exactly(head + 1, sizeof head - 1);
}

static void read_settings(void) {
    read_sockets();
    read_exactly(&settings, sizeof settings);
    int64_t n = settings.machine.n, m = settings.machine.m;
    if (n > STATES || m > INPUTS)
        fail("the loop has more states or inputs than its STATES or INPUTS");
    wire.run_id = settings.run_id;
    noack_wire_key(&wire, settings.key);
    controller.machine = settings.machine;
    controller.has_point = settings.has_point;
    controller.acknowledges = settings.acknowledges;
    controller.predictions = settings.predictions;
    controller.carries_model = settings.carries_model;
    controller.timeout_ns = settings.timeout_ns;
    controller.holds_input = settings.holds_input;
    controller.model_ns = settings.model_ns;
    controller.has_state = settings.has_state;
    controller.newest = settings.newest;
    transitions.n = n;
    transitions.is_static = settings.is_static;
    transitions.H = read_reals(n * n);
    transitions.places = PLACES;
    transitions.steps_ns = steps_ns;
    transitions.matrices = allocate(PLACES * n * n);
    transitions.scratch = allocate(10 * n * n + 3 * n);
    controller.K = read_reals(m * n);
    controller.x_r = read_reals(n);
    controller.u_r = read_reals(m);
    controller.safe_input = read_reals(m);
    controller.x_c = read_reals(n);
    controller.model =
        (noack_model){&transitions, 0, &no_change, &settings.has_point, controller.x_r};
    controller.x = allocate(n);
    controller.u = allocate(m);
    controller.scratch = allocate(3 * n + m);
}

/* ---- The loop ---- */

static int64_t now_ns(void) { return noack_clock_at_ns(&settings.clock, wall_ns()); }

/* When the next tick is due, in the time of the run; INT64_MAX: there is none. */
static int64_t due_ns(void) {
    int64_t t_ns = machine->first_ns + machine->step * machine->period_ns;
    return t_ns > machine->horizon_ns ? INT64_MAX : t_ns + machine->phase_ns;
}

/* Give noack the row of a step, and send its message. */
static void report_step(void) {
    static uint8_t datagram[NOACK_DATAGRAM_BYTES];
    put_frame(output.table, output.row, output.words * 8);
    flush(MSG_DONTWAIT); /* noack receives the row before the message is sent */
    if (!output.sends)
        return;
    output.message.loop = 0;
    int64_t bytes = noack_wire_encode(&wire, &output.message, datagram);
    int to = sockets[output.message.flow == NOACK_ACKNOWLEDGEMENT ? 2 : 1];
    for (int k = 0; k < 2; k++) /* an ICMP error of an earlier datagram makes one call fail */
        if (send(to, datagram, (size_t)bytes, MSG_DONTWAIT) == bytes) {
            counts.sent++;
            return;
        }
    int64_t error = errno;
    put_frame(NOACK_NODE_UNSENT, &error, sizeof error);
}

static void handle(const uint8_t *datagram, int64_t bytes, int64_t from_peer) {
    static noack_message message;
    int64_t examination = noack_wire_examine(
        &wire, &machine->received, 0, datagram, bytes, from_peer, NOACK_NOT_OPENED, &message);
    noack_wire_count(&machine->received, examination, &message);
    if (examination != NOACK_ACCEPTED)
        return;
    noack_controller_handle(&controller, &message, now_ns() - machine->phase_ns, &output);
    report_step();
}

static void receive(void) {
    static uint8_t datagram[NOACK_DATAGRAM_BYTES + 1]; /* a longer one is cut, and rejected */
    for (int k = 0; k < AT_ONCE; k++) {
        struct sockaddr_storage name;
        socklen_t name_bytes = sizeof name;
        ssize_t bytes = recvfrom(
            sockets[0], datagram, sizeof datagram, MSG_DONTWAIT, (struct sockaddr *)&name,
            &name_bytes);
        if (bytes < 0)
            return;
        /* Family, port and host: something may have come before the socket was connected. */
        int from_peer = memcmp(&name, &peer, name.ss_family == AF_INET ? 8 : 24) == 0;
        if (from_peer)
            counts.received++;
        else
            counts.unknown_source++;
        handle(datagram, bytes, from_peer);
    }
}

static void do_ticks(void) {
    for (int k = 0; k < AT_ONCE; k++) {
        int64_t at_ns = now_ns();
        if (at_ns < due_ns())
            return;
        noack_controller_tick(&controller, at_ns - machine->phase_ns, &output);
        report_step();
    }
}

/* A frame from noack, during the run. */
static void read_frame(void) {
    static struct {
        int64_t from_peer;
        uint8_t datagram[1024];
    } forwarded;
    int64_t head[2];
    read_exactly(head, sizeof head);
    if (head[0] == NOACK_NODE_CLOCK && head[1] == sizeof settings.clock) {
        read_exactly(&settings.clock, head[1]);
    } else if (
        head[0] == NOACK_NODE_DATAGRAM && 8 <= head[1] && head[1] <= (int64_t)sizeof forwarded) {
        read_exactly(&forwarded, head[1]);
        handle(forwarded.datagram, head[1] - 8, forwarded.from_peer);
    } else {
        fail("noack has sent an unknown frame");
    }
}

int main(void) {
    printf("noack node %d %zu\n", NOACK_NODE_VERSION, sizeof settings);
    fflush(stdout);
    read_settings();
    struct pollfd files[2] = {{sockets[0], POLLIN, 0}, {STDIN_FILENO, POLLIN, 0}};
    for (int64_t report_ns = 0;;) {
        receive();
        do_ticks();
        int64_t at_ns = wall_ns(), tick_ns = due_ns(), wait_ns = report_ns - at_ns;
        if (wait_ns <= 0) {
            put_counts();
            flush(MSG_DONTWAIT);
            report_ns = at_ns + REPORT_NS;
            wait_ns = REPORT_NS;
        }
        if (tick_ns != INT64_MAX) {
            tick_ns = noack_clock_wait_ns(&settings.clock, tick_ns - now_ns());
            wait_ns = tick_ns < wait_ns ? tick_ns : wait_ns;
        }
        wait_ns = wait_ns > 0 ? wait_ns : 0;
        struct timespec wait = {wait_ns / NS_PER_S, wait_ns % NS_PER_S};
        if (ppoll(files, 2, &wait, NULL) > 0 && files[1].revents != 0)
            read_frame();
    }
}
