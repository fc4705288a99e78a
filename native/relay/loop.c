/* The relay's loop: wait, receive, decide, send, and release delayed datagrams. */
#include "relay.h"

#include <errno.h>
#include <poll.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum {
    FEW_BUFFERS = 16,
    BUSY_NS = 10000, /* a datagram that comes so soon after others is expected to be one of many */
    STALL_NS = 10000000 /* a wait that ends later than that: the relay was stopped meanwhile */
};

enum { NO_CLIENT = -1, REFUSED = -2, FIRST_CLIENTS = 64, HEADROOM_BYTES = 48 * 1024 * 1024 };

static void renew_header(noack_relay *relay, int64_t k) {
    relay_scratch *scratch = scratch_of(relay);
    struct msghdr *message = &scratch->in_headers[k].msg_hdr;
    message->msg_namelen = NOACK_NAME_BYTES;
    message->msg_controllen = (size_t)scratch->control_bytes;
}

static void point_headers(noack_relay *relay) {
    relay_scratch *scratch = scratch_of(relay);
    for (int k = 0; k < BUFFERS; k++) {
        scratch->in_vectors[k] = (struct iovec){scratch->buffers[k], MOST_BYTES};
        scratch->in_headers[k].msg_hdr = (struct msghdr){
            .msg_name = scratch->in_names[k],
            .msg_iov = &scratch->in_vectors[k],
            .msg_iovlen = 1,
            .msg_control = &scratch->in_controls[k],
        };
        scratch->hints[k] = -1;
        renew_header(relay, k);
    }
}

noack_relay *noack_relay_new(
    int64_t links, int64_t clients, int64_t row_count, int64_t epoll, const uint64_t secret[2],
    const char **wrong) {
    *wrong = NULL;
    noack_relay *relay = zeros(1, sizeof *relay);
    if (relay == NULL)
        return NULL;
    relay->links = links;
    relay->epoll = epoll;
    relay->only_socket = relay->free_slot = relay->free_block = -1;
    relay->clock.speed = 1.0;
    relay->change_ns = INT64_MAX;
    relay->segment_below = 1 << 16;
    relay->row_count = row_count;
    relay->records = row_count > 0;
    relay->headroom_bytes = HEADROOM_BYTES;
    memcpy(relay->secret, secret, sizeof relay->secret);
    relay->directions = zeros(2 * links, sizeof *relay->directions);
    relay->packets = zeros(row_count, sizeof *relay->packets);
    relay->releases = zeros(row_count, sizeof *relay->releases);
    relay->scratch = zeros_in_lines(1, sizeof *relay->scratch, &relay->scratch_memory);
    int64_t rows = FIRST_CLIENTS;
    while (rows < clients)
        rows *= 2;
    if (relay->directions == NULL || relay->packets == NULL || relay->releases == NULL
        || relay->scratch == NULL || !add_clients(relay, rows) || !make_room(relay, MOST_BYTES)) {
        noack_relay_free(relay);
        return NULL;
    }
    point_headers(relay);
    return relay;
}

void noack_relay_free(noack_relay *relay) {
    if (relay == NULL)
        return;
    for (int64_t k = 0; k < relay->block_count / NOACK_CHUNK_BLOCKS; k++)
        free(relay->chunks[k]);
    void *const arrays[] = {
        relay->directions, relay->packets, relay->releases, relay->scratch_memory,
        relay->sockets,    relay->table,   relay->heap,     relay->client_memory,
        relay->slots,      relay->waiting, relay->chunks,   relay->block_next,
    };
    for (size_t k = 0; k < sizeof arrays / sizeof *arrays; k++)
        free(arrays[k]);
    free(relay);
}

void noack_relay_read_stamps(noack_relay *relay) {
    relay_scratch *scratch = scratch_of(relay);
    scratch->stamps = 1;
    scratch->control_bytes = CONTROL_BYTES;
    for (int64_t k = scratch->batch_end; k < BUFFERS; k++)
        renew_header(relay, k);
}

int64_t noack_relay_watch(noack_relay *relay, int64_t fd, int64_t socket) {
    struct epoll_event event = {.events = EPOLLIN, .data.u64 = (uint64_t)socket};
    return epoll_ctl((int)relay->epoll, EPOLL_CTL_ADD, (int)fd, &event) == 0 ? 0 : errno;
}

void noack_relay_add_datagram(
    noack_relay *relay, int64_t socket, const uint8_t name[NOACK_NAME_BYTES], const uint8_t *data,
    int64_t size_bytes) {
    relay_scratch *scratch = scratch_of(relay);
    size_bytes = min_of(size_bytes, MOST_BYTES);
    memcpy(scratch->buffers[0], data, (size_t)size_bytes);
    memcpy(scratch->in_names[0], name, NOACK_NAME_BYTES);
    scratch->in_headers[0].msg_len = (unsigned)size_bytes;
    scratch->in_headers[0].msg_hdr.msg_controllen = 0; /* the arrival is unknown */
    scratch->batch_socket = socket;
    scratch->batch_next = 0;
    scratch->batch_end = 1;
    scratch->ready_count = scratch->ready_next = 0;
}

const uint8_t *noack_relay_sender(const noack_relay *relay) {
    return scratch_of(relay)->in_names[scratch_of(relay)->batch_next];
}

int64_t noack_relay_receiver(const noack_relay *relay) { return scratch_of(relay)->batch_socket; }

/* Queue the datagram in the first free row of leaving for sending, behind those of the same socket;
   record its departure. */
static void enqueue_departure(noack_relay *relay) {
    relay_scratch *scratch = scratch_of(relay);
    int32_t row = (int32_t)scratch->leaving_count++;
    departure *leaving = &scratch->leaving[row];
    noack_direction *direction = &relay->directions[leaving->datagram.direction];
    leaving->stale = (uint8_t)noack_link_leave(
        direction->link, relay->clients[leaving->datagram.client].flow_row,
        leaving->datagram.packet, max_of(leaving->datagram.size_bytes - headers_bytes(relay), 0),
        leaving->delayed, leaving->datagram.counts);
    leaving->error = 0;
    int64_t link = leaving->datagram.direction >> 1;
    if (direction->sends == NOACK_OWN_SOCKET)
        leaving->socket = (int32_t)socket_of_client(relay, leaving->datagram.client);
    else if (direction->sends == NOACK_CLIENT_NAME || direction->sends == NOACK_LISTENING_SOCKET)
        leaving->socket = (int32_t)link;
    else
        leaving->socket = (int32_t)(relay->links + link);
    noack_socket *socket = &relay->sockets[leaving->socket];
    if (socket->is_queued) {
        scratch->leaving[socket->tail].next = row;
    } else {
        socket->is_queued = 1;
        socket->head = (uint16_t)row;
        scratch->order[scratch->order_count++] = leaving->socket;
    }
    socket->tail = (uint16_t)row;
    leaving->next = -1;
}

/* Queue the datagrams that are due for sending; return CARRY_ON, or which buffer is full. */
static int64_t release_due(noack_relay *relay, int64_t until_ns) {
    relay_scratch *scratch = scratch_of(relay);
    while (relay->heap_length > 0 && relay->heap[0].due_ns <= until_ns) {
        noack_heap_entry entry = relay->heap[0];
        const noack_slot *slot = &relay->slots[entry.slot];
        if (scratch->leaving_count == LEAVING)
            return NOACK_LEAVING_FULL;
        if (!has_room(relay))
            return NOACK_RECORD_FULL;
        noack_heap_pop(relay->heap, &relay->heap_length);
        relay->now_ns = max_of(relay->now_ns, entry.due_ns);
        relay->clients[slot->client].in_flight--;
        departure *leaving = &scratch->leaving[scratch->leaving_count];
        *leaving = (departure){
            .datagram = *slot,
            .release_ns = entry.due_ns,
            .slot = (int32_t)entry.slot,
            .delayed = 1,
        };
        enqueue_departure(relay);
        serve(
            relay->directions[slot->direction].link, relay->waiting, entry.due_ns, relay->heap,
            &relay->heap_length);
        if (relay->records)
            record_release(relay, leaving, until_ns);
    }
    return NOACK_CARRY_ON;
}

/* The row of the datagram's loop; count a datagram of no loop as refused. */
static int64_t row_of_loop(noack_relay *relay, const uint8_t *data, int64_t size_bytes) {
    int64_t loop = header_loop(data, size_bytes);
    if (0 <= loop && loop < relay->loops)
        return loop;
    relay->no_loop++;
    return REFUSED;
}

/* The row of the current datagram's client, or why there is none; count a refused datagram.

   A datagram is refused if it and its copy might not fit into the store, if it comes from a client
   beyond the maximum number, or if it is of no loop of the run. */
static int64_t client_of(noack_relay *relay, int64_t direction, int64_t size_bytes) {
    relay_scratch *scratch = scratch_of(relay);
    noack_direction *own = &relay->directions[direction];
    const uint8_t *data = scratch->buffers[scratch->batch_next];
    if (own->keeps && !make_room(relay, size_bytes)) {
        own->errors[ENOMEM]++;
        return REFUSED;
    }
    int64_t row = client_of_socket(relay, scratch->batch_socket);
    if (!(direction & 1) || relay->devices) {
        noack_direction *forward = &relay->directions[direction & ~INT64_C(1)];
        row = find_sender(relay);
        if (row < 0 && !own->full)
            return NO_CLIENT;
        if (row < 0) {
            forward->refused++;
            return REFUSED;
        }
    }
    return relay->loops > 0 ? row_of_loop(relay, data, size_bytes) : row;
}

/* Read the arrival time of the current datagram.

   The kernel's timestamps are of the wall clock. One from before the relay's start is ignored: the
   wall clock was set since. */
static void read_arrival(noack_relay *relay) {
    relay_scratch *scratch = scratch_of(relay);
    struct msghdr *message = &scratch->in_headers[scratch->batch_next].msg_hdr;
    scratch->arrival_ns = relay->read_ns;
    struct cmsghdr *control = CMSG_FIRSTHDR(message);
    for (; control != NULL; control = CMSG_NXTHDR(message, control)) {
        if (control->cmsg_level != SOL_SOCKET || control->cmsg_type != SCM_TIMESTAMPNS)
            continue;
        struct timespec stamp;
        memcpy(&stamp, CMSG_DATA(control), sizeof stamp);
        int64_t stamp_ns = (int64_t)stamp.tv_sec * NS_PER_S + stamp.tv_nsec;
        int64_t waited_ns = noack_simulated_ns_of(&relay->clock, scratch->real_ns - stamp_ns);
        if (waited_ns <= relay->read_ns)
            scratch->arrival_ns = relay->read_ns - waited_ns;
    }
}

/* Queue a datagram or its copy for sending if it leaves now, else store it until it is due. It is
   described in the first free row of leaving, where nothing has to be copied. */
static void release(
    noack_relay *relay, int64_t direction, int64_t client, const noack_decision *decision,
    int copy) {
    relay_scratch *scratch = scratch_of(relay);
    const uint8_t *data = scratch->buffers[scratch->batch_next];
    departure *leaving = &scratch->leaving[scratch->leaving_count];
    noack_slot *datagram = &leaving->datagram;
    int64_t release_ns = copy ? decision->copy_ns : decision->release_ns;
    int delayed = release_ns > relay->now_ns;
    datagram->packet = decision->packet;
    datagram->arrival_ns = relay->now_ns;
    datagram->bit = copy ? decision->copy_bit : decision->bit;
    datagram->size_bytes = (int32_t)scratch->in_headers[scratch->batch_next].msg_len;
    datagram->direction = (int32_t)direction;
    datagram->client = (int32_t)client;
    datagram->copy = (uint8_t)copy;
    datagram->counts = (uint8_t)is_first_intact(decision, copy);
    leaving->address = data;
    leaving->release_ns = release_ns;
    leaving->slot = -1;
    leaving->delayed = 0;
    if (delayed || datagram->bit >= 0)
        leaving->slot = (int32_t)store_payload(relay, data, datagram);
    if (!delayed) {
        enqueue_departure(relay);
        return;
    }
    relay->delayed_count++;
    int64_t order = departure_order(direction & 1, relay->delayed_count);
    if (decision->waits)
        wait_for_link(
            relay->directions[direction].link, relay->clients[client].flow_row, relay->waiting,
            leaving->slot, order, decision);
    else
        noack_heap_push(
            relay->heap, &relay->heap_length, (noack_heap_entry){release_ns, order, leaving->slot});
    relay->clients[client].in_flight++;
}

/* Decide for the current datagram, of a client. */
static void decide(noack_relay *relay, int64_t direction, int64_t row, int64_t size_bytes) {
    relay_scratch *scratch = scratch_of(relay);
    noack_client *client = &relay->clients[row];
    const uint8_t *data = scratch->buffers[scratch->batch_next];
    noack_link *link = relay->directions[direction].link;
    noack_decision decision;
    client->last_ns = relay->now_ns;
    serve(link, relay->waiting, relay->now_ns, relay->heap, &relay->heap_length);
    if (!relay->devices && link->scheduler >= 0)
        link->flows[client->flow_row].error_level = header_error_level(data, size_bytes);
    noack_link_decide(
        link, client->flow_row, max_of(size_bytes - headers_bytes(relay), 0), relay->now_ns,
        &decision);
    if (relay->records)
        record_packet(relay, direction, row, data, &decision);
    if (decision.release_ns != NOACK_NEVER_NS)
        release(relay, direction, row, &decision, 0);
    if (decision.copy_ns != NOACK_NEVER_NS)
        release(relay, direction, row, &decision, 1);
    serve(link, relay->waiting, relay->now_ns, relay->heap, &relay->heap_length);
}

/* Decide for the datagrams received from one socket; return CARRY_ON, or why this ended. */
static int64_t decide_batch(noack_relay *relay) {
    relay_scratch *scratch = scratch_of(relay);
    int64_t client = client_of_socket(relay, scratch->batch_socket), reverse = client >= 0;
    int64_t link = reverse ? relay->clients[client].link : scratch->batch_socket;
    if (relay->devices) {
        link = 0;
        reverse = scratch->batch_socket != 0;
    }
    for (; scratch->batch_next < scratch->batch_end; scratch->batch_next++) {
        int64_t size_bytes = scratch->in_headers[scratch->batch_next].msg_len;
        read_arrival(relay);
        /* Decision times ascend, so that a datagram that is due between two arrivals leaves between
           them. In a record, the time of the decision is the machine's input. */
        int64_t now_ns = relay->read_ns;
        if (!relay->records)
            now_ns = min_of(scratch->arrival_ns, relay->read_ns);
        now_ns = max_of(relay->now_ns, now_ns);
        int64_t reason = release_due(relay, now_ns);
        if (reason != NOACK_CARRY_ON)
            return reason;
        relay->now_ns = now_ns;
        if (now_ns >= relay->change_ns)
            return NOACK_CHANGE_DUE;
        if (scratch->leaving_count + 2 > LEAVING)
            return NOACK_LEAVING_FULL;
        if (!has_room(relay))
            return NOACK_RECORD_FULL;
        int64_t row = client_of(relay, 2 * link + reverse, size_bytes);
        if (row == NO_CLIENT)
            return NOACK_NEW_CLIENT;
        if (row >= 0)
            decide(relay, 2 * link + reverse, row, size_bytes);
        renew_header(relay, scratch->batch_next);
    }
    return NOACK_CARRY_ON;
}

/* Wall time until the next delayed datagram is due. */
static int64_t departs_in_ns(const noack_relay *relay) {
    if (relay->heap_length == 0)
        return INT64_MAX;
    return noack_clock_wait_ns(&relay->clock, relay->heap[0].due_ns - relay->read_ns);
}

/* Until when to wait for datagrams; INT64_MIN: the time for housekeeping has come. */
static int64_t waiting_ends_ns(noack_relay *relay, int64_t until_ns) {
    relay_scratch *scratch = scratch_of(relay);
    if (relay->read_ns < until_ns)
        return until_ns;
    if (scratch->due_since_ns == 0)
        scratch->due_since_ns = relay->read_ns;
    int64_t more_ns = 0;
    if (until_ns != INT64_MIN)
        more_ns = noack_put_off_ns(
            &scratch->pauses,
            noack_clock_wait_ns(&relay->clock, relay->read_ns - scratch->due_since_ns),
            departs_in_ns(relay), scratch->has_more != 0, scratch->is_busy != 0);
    if (more_ns == 0) {
        scratch->ready_count = scratch->ready_next = scratch->due_since_ns = 0;
        return INT64_MIN;
    }
    return relay->read_ns + noack_simulated_ns_of(&relay->clock, more_ns) + 1;
}

/* Wait for a datagram or the next release time; return 0 if a signal interrupted it. */
static int wait_for_datagrams(noack_relay *relay, int64_t until_ns) {
    relay_scratch *scratch = scratch_of(relay);
    int64_t wait_ns = noack_clock_wait_ns(&relay->clock, until_ns - relay->read_ns);
    if (relay->heap_length > 0)
        wait_ns = max_of(min_of(wait_ns, departs_in_ns(relay) - relay->spin_ns), 0);
    struct timespec limit = {wait_ns / NS_PER_S, wait_ns % NS_PER_S};
    int fd = (int)relay->epoll;
    if (relay->only_socket >= 0)
        fd = relay->sockets[relay->only_socket].fd;
    struct pollfd readable = {.fd = fd, .events = POLLIN};
    int ready = ppoll(&readable, 1, &limit, NULL);
    if (ready > 0 && relay->only_socket >= 0) {
        scratch->ready[0].events = readable.revents & POLLERR ? EPOLLERR : EPOLLIN;
        scratch->ready[0].data.u64 = (uint64_t)relay->only_socket;
    } else if (ready > 0) {
        ready = epoll_wait(fd, scratch->ready, READY, 0);
    }
    scratch->ready_count = max_of(ready, 0);
    scratch->ready_next = 0;
    if (scratch->ready_count == 0) {
        relay->read_ns = run_time_ns(&relay->clock);
        scratch->has_more = ready < 0;
    }
    return ready >= 0;
}

/* Receive datagrams from a socket, as far as there are buffers; return 0, or errno if there are
   none.

   If the last datagrams came one at a time, it receives one: looking for another takes time. */
static int receive(noack_relay *relay, int64_t socket, int flags) {
    relay_scratch *scratch = scratch_of(relay);
    int64_t begin = scratch->batch_end, before_ns = relay->read_ns;
    int fd = relay->sockets[socket].fd, most = scratch->is_busy ? (int)(BUFFERS - begin) : 1,
        received;
    if (relay->devices) {
        received = read_packets(relay, socket, most);
    } else if (scratch->is_busy) {
        received = recvmmsg(fd, &scratch->in_headers[begin], (unsigned)most, flags, NULL);
    } else {
        ssize_t size_bytes = recvmsg(fd, &scratch->in_headers[begin].msg_hdr, flags & MSG_DONTWAIT);
        scratch->in_headers[begin].msg_len = (unsigned)max_of(size_bytes, 0);
        received = size_bytes < 0 ? -1 : 1;
    }
    int error = received > 0 ? 0 : errno;
    relay->read_ns = run_time_ns(&relay->clock);
    if (scratch->stamps)
        scratch->real_ns = clock_ns(CLOCK_REALTIME);
    scratch->is_busy = received > 1 || relay->read_ns - before_ns < BUSY_NS;
    scratch->has_more = error == EINTR || (scratch->is_busy && received == most);
    if (received > 0) {
        scratch->batch_socket = socket;
        scratch->batch_next = begin;
        scratch->batch_end = begin + received;
        touch_clients(relay);
    }
    return error;
}

/* Receive from the next socket that is ready. */
static void receive_ready(noack_relay *relay) {
    relay_scratch *scratch = scratch_of(relay);
    const struct epoll_event *event = &scratch->ready[scratch->ready_next++];
    if (event->events & EPOLLERR)
        take_errors(relay, (int64_t)event->data.u64);
    receive(relay, (int64_t)event->data.u64, MSG_DONTWAIT);
}

/* Whether the receiving call is to wait, which saves the call of epoll: it ends late by up to a
   tick of the kernel, hence not if a datagram is delayed or housekeeping is due before. */
static int receiving_waits(const noack_relay *relay, int64_t until_ns) {
    return relay->only_socket >= 0 && relay->heap_length == 0
           && noack_clock_wait_ns(&relay->clock, until_ns - relay->read_ns)
                  >= relay->receive_wait_ns;
}

/* Wait in the receiving call; return 0 if a signal interrupted it. */
static int wait_and_receive(noack_relay *relay) {
    int error = receive(relay, relay->only_socket, MSG_WAITFORONE);
    if (error != 0 && error != EAGAIN && error != EINTR)
        take_errors(relay, relay->only_socket);
    return error != EINTR;
}

/* Do not count the time in which the relay was stopped as one for which housekeeping was put off:
   the datagrams that arrived meanwhile come first. */
static void leave_out_stall(noack_relay *relay, int64_t wait_until_ns) {
    relay_scratch *scratch = scratch_of(relay);
    int64_t late_ns = relay->read_ns - wait_until_ns;
    if (scratch->due_since_ns != 0 && noack_clock_wait_ns(&relay->clock, late_ns) > STALL_NS)
        scratch->due_since_ns += late_ns;
}

/* Wait for datagrams or the next release time; return 0 if a signal interrupted it. */
static int wait_until(noack_relay *relay, int64_t until_ns) {
    int in_receive = receiving_waits(relay, until_ns);
    int completed = in_receive ? wait_and_receive(relay) : wait_for_datagrams(relay, until_ns);
    leave_out_stall(relay, until_ns);
    return completed;
}

int64_t noack_relay_run(noack_relay *relay, int64_t until_ns) {
    relay_scratch *scratch = scratch_of(relay);
    for (;;) {
        int64_t reason = NOACK_CARRY_ON, sent_ns = -1;
        if (scratch->batch_next < scratch->batch_end)
            reason = decide_batch(relay);
        if (reason == NOACK_CARRY_ON)
            reason = release_due(relay, relay->read_ns);
        int all_read = scratch->ready_next >= scratch->ready_count;
        if (reason != NOACK_CARRY_ON || all_read || BUFFERS - scratch->batch_end < FEW_BUFFERS) {
            if (scratch->leaving_count > 0)
                sent_ns = send_all(relay);
            scratch->pauses.worked_since_wait |= sent_ns >= 0;
            if (reason == NOACK_LEAVING_FULL)
                continue;
            if (reason != NOACK_CARRY_ON)
                return reason;
            scratch->batch_next = scratch->batch_end = 0;
        }
        if (all_read) {
            relay->read_ns = sent_ns >= 0 ? sent_ns : run_time_ns(&relay->clock);
            int64_t wait_until_ns = waiting_ends_ns(relay, until_ns);
            if (wait_until_ns == INT64_MIN)
                return NOACK_HOUSEKEEPING;
            scratch->pauses.worked_since_wait = 0;
            if (!wait_until(relay, wait_until_ns))
                return NOACK_INTERRUPTED;
        }
        if (scratch->ready_next < scratch->ready_count)
            receive_ready(relay);
    }
}
