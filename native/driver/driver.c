/* The live driver: messages and ticks of the machines of a process, in real time. */
#define _GNU_SOURCE
#include "../core.h"

#include <errno.h>
#include <netinet/in.h>
#include <netinet/udp.h>
#include <sched.h>
#include <stddef.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <sys/timerfd.h>
#include <time.h>
#include <unistd.h>

enum {
    BUFFERS = 64, /* datagrams that are handled or sent at once; the kernel segments as many */
    TICKS = 64,   /* that are done before it receives again */
    BUFFER_BYTES = 576, /* a longer datagram is cut, and rejected by its length */
    MESSAGES = 16,      /* received at once; the last place is for a datagram that Python adds */
    MESSAGE_BYTES = BUFFERS * BUFFER_BYTES, /* a message of the kernel has several datagrams */
    MANY_BYTES = 98304, /* of rows: as many go to the recorder without a pause */
    EARLY_NS = 1000     /* a timer may expire so much before its time */
};

typedef union { /* room for the size of the datagrams in a message */
    struct cmsghdr head;
    uint8_t bytes[CMSG_SPACE(sizeof(int))];
} control;

typedef struct { /* a datagram that was received */
    uint8_t *data;
    int64_t size_bytes;
    const uint8_t *name;
} arrival;

typedef struct {
    struct mmsghdr in_headers[MESSAGES], out_headers[BUFFERS];
    struct iovec in_vectors[MESSAGES], out_vectors[BUFFERS];
    control in_controls[MESSAGES];
    uint8_t in_names[MESSAGES][NOACK_NAME_BYTES];
    int64_t message_next, message_end; /* the messages of which datagrams are still to be taken */
    int64_t taken_bytes;               /* of the next one */
    arrival arrivals[BUFFERS];
    int64_t in_next, in_end; /* the current datagram, and the end of those taken */
    int64_t is_unsegmented;  /* 1: the kernel does not segment what this process sends */
    int64_t out_count, sealed_count;
    int64_t is_sealing;        /* 1: Python encrypts what waits to be sent */
    int64_t reason;            /* why the driver returns then */
    int64_t is_accepted;       /* 1: the current datagram has become the message */
    int64_t is_ticking;        /* 1: a tick waits for an answer */
    int64_t now_ns;            /* time of the message or tick */
    int64_t batch;             /* datagrams that one call receives */
    int64_t timer_ns;          /* when the timer expires, on the monotonic clock */
    int8_t out_flows[BUFFERS]; /* the sockets of what waits to be sent */
    pauses pauses;
    int64_t has_more;  /* 1: a socket may have more datagrams than were received */
    int64_t first;     /* the socket that is read first the next time */
    int64_t has_asked; /* 1: the present step has asked Python */
    noack_message message;
    uint8_t out_data[BUFFERS][BUFFER_BYTES];
    uint8_t in_data[MESSAGES][MESSAGE_BYTES];
} driver_scratch;

int64_t clock_ns(int clock) {
    struct timespec now;
    clock_gettime(clock, &now);
    return (int64_t)now.tv_sec * NS_PER_S + now.tv_nsec;
}

int64_t run_time_ns(const noack_clock *clock) {
    return noack_clock_at_ns(clock, clock_ns(CLOCK_MONOTONIC));
}

static driver_scratch *scratch_of(const noack_driver *driver) { return driver->scratch; }

int64_t noack_driver_scratch_bytes(void) { return (int64_t)sizeof(driver_scratch); }

static int is_name(const noack_peer *peer) {
    return 0 <= peer->name_bytes && peer->name_bytes <= NOACK_NAME_BYTES;
}

const char *noack_driver_check(const noack_driver *driver) {
    if (!(driver->clock.speed > 0))
        return "clock.speed: not above 0";
    if (driver->clock.slew_ppb < 0 || driver->clock.slew_ppb >= NS_PER_S)
        return "clock.slew_ppb: not from 0 to 10^9";
    if (driver->spin_ns < 0 || driver->rest_ns < 0 || driver->rest_ns >= NS_PER_S)
        return "spin_ns, rest_ns: a time below 0 or of 1 s";
    if (driver->receiver_count < 0 || driver->receiver_count > 2)
        return "receiver_count: not from 0 to 2";
    for (int k = 0; k < 2; k++)
        if (!is_name(&driver->sources[k]))
            return "name_bytes: not from 0 to 32";
    return NULL;
}

static void renew_header(driver_scratch *own, int64_t k) {
    own->in_headers[k].msg_hdr.msg_namelen = NOACK_NAME_BYTES;
    own->in_headers[k].msg_hdr.msg_control = &own->in_controls[k];
    own->in_headers[k].msg_hdr.msg_controllen = sizeof own->in_controls[k];
}

/* Let epoll report a file that can be read by a bit; return 0 or errno. */
static int64_t watch(const noack_driver *driver, int64_t fd, uint64_t bit) {
    struct epoll_event event = {.events = EPOLLIN, .data.u64 = bit};
    return epoll_ctl((int)driver->epoll, EPOLL_CTL_ADD, (int)fd, &event) == 0 ? 0 : errno;
}

int64_t noack_driver_open(noack_driver *driver) {
    driver_scratch *own = scratch_of(driver);
    for (int k = 0; k < BUFFERS; k++) {
        own->out_vectors[k] = (struct iovec){own->out_data[k], 0};
        own->out_headers[k].msg_hdr =
            (struct msghdr){.msg_iov = &own->out_vectors[k], .msg_iovlen = 1};
    }
    for (int k = 0; k < MESSAGES; k++) {
        own->in_vectors[k] = (struct iovec){own->in_data[k], MESSAGE_BYTES};
        own->in_headers[k].msg_hdr = (struct msghdr){
            .msg_name = own->in_names[k], .msg_iov = &own->in_vectors[k], .msg_iovlen = 1};
        renew_header(own, k);
    }
    /* A call that has received as many as it may does not look for another one. */
    own->batch = min_of(driver->process->loops, MESSAGES - 1);
    driver->senders[0] = driver->senders[1] = -1;
    driver->timer = timerfd_create(CLOCK_MONOTONIC, TFD_CLOEXEC);
    driver->epoll = epoll_create1(EPOLL_CLOEXEC);
    return driver->timer < 0 || driver->epoll < 0 ? errno : watch(driver, driver->timer, 0);
}

int64_t noack_driver_watch(noack_driver *driver) {
    int64_t error = 0;
    for (int k = 0; k < driver->receiver_count && error == 0; k++)
        error = watch(driver, driver->receivers[k], UINT64_C(1) << k);
    return error;
}

static void close_fd(int64_t *fd) {
    if (*fd >= 0)
        close((int)*fd);
    *fd = -1;
}

void noack_driver_close(noack_driver *driver) {
    close_fd(&driver->epoll);
    close_fd(&driver->timer);
}

/* Whether a name is that of a peer: the same family, port and host. */
static int is_peer(const uint8_t name[NOACK_NAME_BYTES], const noack_peer *peer) {
    sa_family_t family;
    memcpy(&family, name, sizeof family);
    if (peer->name_bytes == 0 || memcmp(name, peer->name, 4) != 0)
        return 0;
    size_t host = family == AF_INET ? offsetof(struct sockaddr_in, sin_addr)
                                    : offsetof(struct sockaddr_in6, sin6_addr);
    return memcmp(name + host, peer->name + host, family == AF_INET ? 4 : 16) == 0;
}

void noack_driver_add_datagram(
    noack_driver *driver, const uint8_t name[NOACK_NAME_BYTES], const uint8_t *data,
    int64_t size_bytes) {
    driver_scratch *own = scratch_of(driver);
    uint8_t *place = own->in_data[MESSAGES - 1];
    size_bytes = min_of(size_bytes, BUFFER_BYTES);
    memcpy(place, data, (size_t)size_bytes);
    memcpy(own->in_names[MESSAGES - 1], name, NOACK_NAME_BYTES);
    if (own->in_next == own->in_end)
        own->in_next = own->in_end = 0;
    own->arrivals[own->in_end++] = (arrival){place, size_bytes, own->in_names[MESSAGES - 1]};
}

/* Send datagrams of one size as one message, which goes through the kernel once. Return their
   number, or -1 if that fails: the network's interface may refuse such messages. */
static int send_segmented(driver_scratch *own, int fd, int64_t place, int64_t count) {
    uint16_t size = (uint16_t)own->out_vectors[place].iov_len;
    control size_control = {
        .head = {
            .cmsg_level = IPPROTO_UDP,
            .cmsg_type = UDP_SEGMENT,
            .cmsg_len = CMSG_LEN(sizeof size)}};
    memcpy(CMSG_DATA(&size_control.head), &size, sizeof size);
    struct msghdr message = {
        .msg_iov = &own->out_vectors[place],
        .msg_iovlen = (size_t)count,
        .msg_control = &size_control,
        .msg_controllen = CMSG_SPACE(sizeof size)};
    if (sendmsg(fd, &message, MSG_DONTWAIT) >= 0)
        return (int)count;
    own->is_unsegmented = errno == EINVAL || errno == EIO || errno == EMSGSIZE;
    return -1;
}

/* Send datagrams of one socket, from a place on; return the number of those that were sent, or -1.
 */
static int call_send(driver_scratch *own, int fd, int64_t place, int64_t count) {
    const struct iovec *vectors = &own->out_vectors[place];
    int64_t equal = 1;
    while (equal < count && vectors[equal].iov_len == vectors[0].iov_len)
        equal++;
    if (equal > 1 && !own->is_unsegmented) {
        int sent = send_segmented(own, fd, place, equal);
        if (sent > 0 || !own->is_unsegmented)
            return sent;
    }
    if (count > 1)
        return sendmmsg(fd, &own->out_headers[place], (unsigned)count, MSG_DONTWAIT);
    const struct iovec *vector = &own->out_vectors[place];
    return send(fd, vector->iov_base, vector->iov_len, MSG_DONTWAIT) < 0 ? -1 : 1;
}

/* Send the datagrams that wait; a failure is counted. An ICMP error of an earlier datagram makes
   one call fail, too, so each is tried twice. */
static void send_all(noack_driver *driver) {
    driver_scratch *own = scratch_of(driver);
    int has_failed = 0;
    for (int64_t k = 0, end; k < own->out_count;) {
        for (end = k + 1; end < own->out_count && own->out_flows[end] == own->out_flows[k];)
            end++;
        int sent = call_send(own, (int)driver->senders[own->out_flows[k]], k, end - k);
        if (sent > 0) {
            driver->sent += sent;
            k += sent;
            has_failed = 0;
        } else if (errno != EINTR && !(has_failed ^= 1)) {
            driver->errors[errno & (NOACK_ERRNOS - 1)]++;
            k++;
        }
    }
    own->out_count = own->sealed_count = 0;
}

/* Write the datagram of the message that a machine sends, if it sends one. There must be room. */
static void put_output(noack_driver *driver) {
    driver_scratch *own = scratch_of(driver);
    const noack_output *output = &driver->process->output;
    own->pauses.worked = 1;
    if (!output->sends)
        return;
    int64_t place = own->out_count++;
    own->out_flows[place] = output->message.flow == NOACK_ACKNOWLEDGEMENT;
    own->out_vectors[place].iov_len =
        (size_t)noack_wire_encode(&driver->wire, &output->message, own->out_data[place]);
}

/* Show Python the datagram that it opens or seals. */
static void point_to(noack_driver *driver, uint8_t *datagram, int64_t size_bytes) {
    driver->datagram = datagram;
    driver->datagram_bytes = size_bytes;
}

/* Whether the next datagram to send must be encrypted. */
static int must_seal(noack_driver *driver) {
    driver_scratch *own = scratch_of(driver);
    own->is_sealing = driver->wire.encrypted && own->sealed_count < own->out_count;
    if (own->is_sealing) {
        int64_t place = own->sealed_count++;
        point_to(driver, own->out_data[place], (int64_t)own->out_vectors[place].iov_len);
    }
    return own->is_sealing != 0;
}

/* Ask Python for what a step needs. */
static int64_t ask(noack_driver *driver, int64_t question) {
    driver->question = question;
    scratch_of(driver)->has_asked = question != NOACK_ROWS_FULL;
    return question == NOACK_ROWS_FULL ? NOACK_DRIVER_ROWS : NOACK_DRIVER_QUESTION;
}

/* Examine the current datagram; return NOACK_DRIVER_OPEN if it must be opened. */
static int64_t examine(noack_driver *driver) {
    driver_scratch *own = scratch_of(driver);
    const arrival *current = &own->arrivals[own->in_next];
    uint8_t *datagram = current->data;
    int64_t size_bytes = current->size_bytes;
    int64_t loop = noack_wire_loop(datagram, size_bytes);
    int is_answer = driver->sources[1].name_bytes > 0
                    && noack_wire_flow(datagram, size_bytes) == NOACK_ACKNOWLEDGEMENT;
    if (loop >= driver->process->loops) /* rejected by the first loop */
        loop = 0;
    noack_machine *machine = noack_process_machine(driver->process, max_of(loop, 0));
    noack_reception *reception = is_answer ? &machine->acknowledgements : &machine->received;
    own->now_ns = run_time_ns(&driver->clock);
    int64_t found = NOACK_BAD_TAG;
    if (driver->opened != NOACK_NOT_AUTHENTIC)
        found = noack_wire_examine(
            &driver->wire, reception, max_of(loop, 0), datagram, size_bytes,
            is_peer(current->name, &driver->sources[is_answer]), driver->opened, &own->message);
    if (found == NOACK_ENCRYPTED)
        return NOACK_DRIVER_OPEN;
    driver->opened = NOACK_NOT_OPENED;
    noack_wire_count(reception, found, &own->message);
    own->is_accepted = found == NOACK_ACCEPTED;
    return NOACK_DRIVER_NOTHING;
}

/* Whether to look at the time and the sockets after a step: Python's answer may have taken long. */
static int has_asked(noack_driver *driver) {
    driver_scratch *own = scratch_of(driver);
    int asked = own->has_asked != 0;
    own->has_asked = 0;
    return asked;
}

/* Handle the datagrams received, up to one that Python was asked about. */
static int64_t handle_messages(noack_driver *driver) {
    driver_scratch *own = scratch_of(driver);
    while (own->in_next < own->in_end && own->out_count < BUFFERS) {
        if (!own->is_accepted && examine(driver) == NOACK_DRIVER_OPEN)
            return NOACK_DRIVER_OPEN;
        if (own->is_accepted) {
            int64_t question = noack_process_handle(driver->process, &own->message, own->now_ns);
            if (question != NOACK_DONE)
                return ask(driver, question);
            put_output(driver);
        }
        own->is_accepted = 0;
        own->in_next++;
        if (has_asked(driver))
            break;
    }
    return NOACK_DRIVER_NOTHING;
}

/* Do ticks that are due, up to one that Python was asked about. */
static int64_t do_ticks(noack_driver *driver) {
    driver_scratch *own = scratch_of(driver);
    for (int count = 0; count < TICKS && own->out_count < BUFFERS; count++) {
        if (!own->is_ticking) {
            int64_t due_ns = noack_process_due_ns(driver->process);
            if (due_ns == INT64_MAX)
                break;
            own->now_ns = run_time_ns(&driver->clock);
            if (own->now_ns < due_ns)
                break;
            own->is_ticking = 1;
        }
        int64_t question = noack_process_tick(driver->process, own->now_ns);
        if (question != NOACK_DONE)
            return ask(driver, question);
        own->is_ticking = 0;
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
    driver_scratch *own = scratch_of(driver);
    if (wall_ns < own->timer_ns && own->timer_ns <= at_ns && at_ns - own->timer_ns < EARLY_NS)
        return;
    struct itimerspec at = {.it_value = {at_ns / NS_PER_S, at_ns % NS_PER_S}};
    timerfd_settime((int)driver->timer, TFD_TIMER_ABSTIME, &at, NULL);
    own->timer_ns = at_ns;
}

/* Sleep until a socket has datagrams, a tick is near, or for wait_ns from wall_ns on. Return the
   sockets to read as bits, or -1 if a signal interrupted it. */
static int64_t sleep_until_needed(
    noack_driver *driver, int64_t wall_ns, int64_t tick_ns, int64_t wait_ns) {
    driver_scratch *own = scratch_of(driver);
    int rests = own->pauses.worked && !own->has_more && 0 < tick_ns && tick_ns < driver->rest_ns;
    own->pauses.worked = 0;
    if (rests) {
        struct timespec rest = {0, driver->rest_ns};
        return clock_nanosleep(CLOCK_MONOTONIC, 0, &rest, NULL) == EINTR
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

/* Receive at most a number of messages from a place on; return their number. After an ICMP error of
   a datagram, it fails once. Of several loops, a message may have several datagrams. */
static int64_t call_receive(driver_scratch *own, int fd, int64_t place, int64_t most) {
    if (own->batch > 1)
        return recvmmsg(fd, &own->in_headers[place], (unsigned)most, MSG_DONTWAIT, NULL);
    socklen_t name_bytes = NOACK_NAME_BYTES;
    ssize_t size_bytes = recvfrom(
        fd, own->in_data[place], BUFFER_BYTES, MSG_DONTWAIT,
        (struct sockaddr *)own->in_names[place], &name_bytes);
    own->in_headers[place].msg_len = (unsigned)max_of(size_bytes, 0);
    own->in_headers[place].msg_hdr.msg_controllen = 0;
    return size_bytes < 0 ? -1 : 1;
}

/* The size of the datagrams in a message; only the last one may be smaller. */
static int64_t segment_bytes(const struct mmsghdr *message) {
    struct msghdr head = message->msg_hdr;
    for (struct cmsghdr *part = CMSG_FIRSTHDR(&head); part; part = CMSG_NXTHDR(&head, part))
        if (part->cmsg_level == IPPROTO_UDP && part->cmsg_type == UDP_GRO) {
            int size_bytes;
            memcpy(&size_bytes, CMSG_DATA(part), sizeof size_bytes);
            return max_of(size_bytes, 1);
        }
    return message->msg_len;
}

/* Take datagrams out of the messages that were received, and count their sources. */
static void take_arrivals(noack_driver *driver) {
    driver_scratch *own = scratch_of(driver);
    own->in_next = own->in_end = 0;
    /* One place is left for a datagram that Python adds. */
    while (own->message_next < own->message_end && own->in_end < BUFFERS - 1) {
        int64_t number = own->message_next, all_bytes = own->in_headers[number].msg_len;
        int64_t size_bytes =
            min_of(segment_bytes(&own->in_headers[number]), all_bytes - own->taken_bytes);
        const uint8_t *name = own->in_names[number];
        own->arrivals[own->in_end++] =
            (arrival){own->in_data[number] + own->taken_bytes, size_bytes, name};
        own->taken_bytes += size_bytes;
        int64_t source = 0;
        while (source < 2 && !is_peer(name, &driver->sources[source]))
            source++;
        if (source < 2)
            driver->sources[source].received++;
        else
            driver->foreign++;
        if (own->taken_bytes == all_bytes) {
            renew_header(own, number);
            own->taken_bytes = 0;
            own->message_next++;
        }
    }
}

/* Receive messages from the sockets that have some. They are read first in turn: one that always
   has many would leave no room for the other. */
static void receive(noack_driver *driver, int64_t ready) {
    driver_scratch *own = scratch_of(driver);
    own->message_next = own->message_end = own->taken_bytes = own->has_more = 0;
    for (int64_t turn = 0; turn < driver->receiver_count; turn++) {
        int64_t k = (own->first + turn) % driver->receiver_count;
        int64_t most = min_of(own->batch, MESSAGES - 1 - own->message_end);
        if (!(ready >> k & 1) || most == 0)
            continue;
        int64_t taken = call_receive(own, (int)driver->receivers[k], own->message_end, most);
        own->message_end += max_of(taken, 0);
        own->has_more |= taken == most;
    }
    own->first ^= 1;
    take_arrivals(driver);
}

/* How long to wait for, at most, or 0 if the time for housekeeping has come. */
static int64_t wait_for_ns(
    noack_driver *driver, int64_t until_ns, int64_t now_ns, int64_t tick_ns) {
    if (now_ns < until_ns)
        return max_of(noack_clock_wait_ns(&driver->clock, until_ns - now_ns), 1);
    if (until_ns == INT64_MIN) /* what has been received is still to be handled */
        return 1;
    if (driver->rest_ns > 0) /* no moment is better than another */
        return 0;
    int64_t overdue_ns = noack_clock_wait_ns(&driver->clock, now_ns - until_ns);
    return put_off_ns(&scratch_of(driver)->pauses, overdue_ns, tick_ns, 0, 0);
}

/* Whether a table has so many rows that Python should take them before the next steps: few at a
   time keep it for a short time only. */
static int has_many_rows(const noack_process *process) {
    for (int k = 0; k < NOACK_TABLES; k++)
        if (process->tables[k].count * process->tables[k].row_bytes >= MANY_BYTES)
            return 1;
    return 0;
}

int64_t noack_drive(noack_driver *driver, int64_t until_ns) {
    driver_scratch *own = scratch_of(driver);
    for (;;) {
        if (!own->is_sealing)
            own->reason = do_steps(driver);
        if (must_seal(driver))
            return NOACK_DRIVER_SEAL;
        if (own->out_count > 0)
            send_all(driver);
        if (own->reason == NOACK_DRIVER_OPEN)
            point_to(
                driver, own->arrivals[own->in_next].data, own->arrivals[own->in_next].size_bytes);
        if (own->reason != NOACK_DRIVER_NOTHING)
            return own->reason;
        if (own->in_next == own->in_end && own->message_next < own->message_end)
            take_arrivals(driver);
        if (until_ns == INT64_MIN && own->in_next == own->in_end)
            return NOACK_DRIVEN;
        if (has_many_rows(driver->process))
            return NOACK_DRIVER_ROWS;
        int64_t wall_ns = clock_ns(CLOCK_MONOTONIC);
        int64_t now_ns = noack_clock_at_ns(&driver->clock, wall_ns);
        int64_t tick_ns = next_tick_ns(driver, now_ns);
        int64_t wait_ns = wait_for_ns(driver, until_ns, now_ns, tick_ns);
        if (wait_ns == 0)
            return NOACK_DRIVEN;
        if (own->in_next < own->in_end)
            continue;
        int64_t ready = sleep_until_needed(driver, wall_ns, tick_ns, wait_ns);
        if (ready < 0)
            return NOACK_DRIVEN;
        if (ready > 0)
            receive(driver, ready);
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
