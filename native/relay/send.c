/* Sends the queued datagrams: one call per socket, each flow in its order. */
#include "relay.h"

#include <errno.h>
#include <linux/errqueue.h>
#include <netinet/in.h>
#include <netinet/udp.h>
#include <poll.h>
#include <string.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

enum {
    CALLS_PER_READING = 8, /* of the clock */
    /* In one message: every kernel with UDP_SEGMENT accepts 64. Of a longer message, a full queue
       of the device (tbf) loses more without an error. */
    MOST_SEGMENTS = 64,
    MOST_SEGMENTED_BYTES = 65507,
    TRIES = 3,
    /* Maximum number of tries. An ICMP error of an earlier datagram makes one send fail. A send
       that fails without an ICMP error in the error queue, or this often, is expected to fail
       again. */
    MOST_TRIES = 64,
    /* Maximum time to wait for a full socket. There is no wait for a full queue of the device
       (ENOBUFS), since it would delay other links. */
    PATIENCE_NS = 50000000
};

static int is_icmp(const struct cmsghdr *control, struct sock_extended_err *error) {
    int is_error = (control->cmsg_level == IPPROTO_IP && control->cmsg_type == IP_RECVERR)
                   || (control->cmsg_level == IPPROTO_IPV6 && control->cmsg_type == IPV6_RECVERR);
    if (!is_error || control->cmsg_len < CMSG_LEN(sizeof *error))
        return 0;
    memcpy(error, CMSG_DATA(control), sizeof *error);
    /* Errors of other origins are local; they make the call itself fail. */
    return error->ee_origin == SO_EE_ORIGIN_ICMP || error->ee_origin == SO_EE_ORIGIN_ICMP6;
}

/* The errno of a message of the error queue if it comes from ICMP, else 0. */
static int64_t icmp_error(struct msghdr *message) {
    struct sock_extended_err error;
    struct cmsghdr *control = CMSG_FIRSTHDR(message);
    for (; control != NULL; control = CMSG_NXTHDR(message, control))
        if (is_icmp(control, &error))
            return error.ee_errno;
    return 0;
}

/* Empty a socket's error queue; return the number of ICMP errors. Port-unreachable errors of the
   destination are counted.

   With IP_RECVERR, a send to a full device queue fails (ENOBUFS). However, each ICMP error also
   makes the socket's next call fail once. Therefore the error queue is emptied after a failed call,
   to see whether an ICMP error caused the failure. */
int64_t take_errors(noack_relay *relay, int64_t socket) {
    relay_scratch *scratch = scratch_of(relay);
    int64_t icmp_errors = 0, client = client_of_socket(relay, socket);
    int message_count = relay->devices ? 0 : ERRORS, fd = relay->sockets[socket].fd;
    while (message_count == ERRORS) {
        for (int k = 0; k < ERRORS; k++) {
            struct msghdr *message = &scratch->error_headers[k].msg_hdr;
            *message = (struct msghdr){
                .msg_control = &scratch->error_controls[k], .msg_controllen = ERROR_CONTROL_BYTES};
        }
        message_count =
            recvmmsg(fd, scratch->error_headers, ERRORS, MSG_DONTWAIT | MSG_ERRQUEUE, NULL);
        for (int k = 0; k < message_count; k++) {
            int64_t error = icmp_error(&scratch->error_headers[k].msg_hdr), link = -1;
            icmp_errors += error != 0;
            if (client >= 0)
                link = relay->clients[client].link;
            else if (socket >= relay->links)
                link = socket - relay->links;
            if (error == ECONNREFUSED && link >= 0)
                relay->directions[2 * link].port_unreachable++;
        }
    }
    return icmp_errors;
}

static int64_t vectors_of(const departure *leaving) {
    return leaving->slot < 0 ? 1 : blocks_for(leaving->datagram.size_bytes);
}

/* Write the vectors of a datagram's payload; return the next free one. Small payloads of a message,
   whose vectors begin at first, are copied behind each other: they share a vector. */
static int64_t add_vectors(
    const noack_relay *relay, int64_t first, int64_t count, const departure *leaving) {
    relay_scratch *scratch = scratch_of(relay);
    struct iovec *vectors = scratch->out_vectors;
    size_t size_bytes = (size_t)leaving->datagram.size_bytes;
    if (leaving->slot < 0 && relay->segment && size_bytes <= FEW_BYTES) {
        uint8_t *place = scratch->joined + scratch->joined_bytes;
        memcpy(place, leaving->address, size_bytes);
        scratch->joined_bytes += leaving->datagram.size_bytes;
        struct iovec *last = count > first ? &vectors[count - 1] : NULL;
        if (last != NULL && (uint8_t *)last->iov_base + last->iov_len == place) {
            last->iov_len += size_bytes;
            return count;
        }
        vectors[count] = (struct iovec){place, size_bytes};
        return count + 1;
    }
    if (leaving->slot < 0) {
        vectors[count] = (struct iovec){(void *)leaving->address, size_bytes};
        return count + 1;
    }
    int64_t block = leaving->datagram.block, left_bytes = leaving->datagram.size_bytes;
    for (int64_t k = blocks_for(left_bytes); k > 0; k--) {
        int64_t length = min_of(left_bytes, NOACK_BLOCK_BYTES);
        vectors[count++] = (struct iovec){block_address(relay, block), (size_t)length};
        left_bytes -= length;
        block = relay->block_next[block];
    }
    return count;
}

/* Whether a datagram may follow others of size_bytes in one message that the kernel segments. */
static int may_join(
    const noack_relay *relay, const departure *first, const departure *other, int64_t all_bytes) {
    int to_client = relay->directions[first->datagram.direction].sends == NOACK_CLIENT_NAME;
    return 0 < other->datagram.size_bytes
           && other->datagram.size_bytes <= first->datagram.size_bytes
           && all_bytes + other->datagram.size_bytes <= MOST_SEGMENTED_BYTES
           && other->datagram.direction == first->datagram.direction
           && (other->datagram.client == first->datagram.client || !to_client);
}

static void write_segment_size(struct msghdr *message, control *room, int64_t size_bytes) {
    uint16_t size = (uint16_t)size_bytes;
    message->msg_control = room;
    message->msg_controllen = CMSG_SPACE(sizeof size);
    room->head.cmsg_level = IPPROTO_UDP;
    room->head.cmsg_type = UDP_SEGMENT;
    room->head.cmsg_len = CMSG_LEN(sizeof size);
    memcpy(CMSG_DATA(&room->head), &size, sizeof size);
}

static void write_destination(
    const noack_relay *relay, struct msghdr *message, const departure *leaving) {
    noack_direction *direction = &relay->directions[leaving->datagram.direction];
    if (direction->sends == NOACK_CLIENT_NAME) {
        message->msg_name = relay->clients[leaving->datagram.client].name;
        message->msg_namelen = (socklen_t)relay->clients[leaving->datagram.client].name_bytes;
    } else if (direction->sends == NOACK_DESTINATION_NAME) {
        message->msg_name = direction->name;
        message->msg_namelen = (socklen_t)direction->name_bytes;
    }
}

/* Fill a message with a datagram and the following ones that the kernel can segment; return the
   datagram after them, and add to the number of vectors in use. */
static int64_t fill_message(noack_relay *relay, int header, int64_t row, int64_t *vectors) {
    relay_scratch *scratch = scratch_of(relay);
    const departure *first = &scratch->leaving[row];
    struct msghdr *message = &scratch->out_headers[header].msg_hdr;
    int64_t begin = *vectors, size_bytes = first->datagram.size_bytes, all_bytes = size_bytes;
    int64_t end = add_vectors(relay, begin, begin, first), last_bytes = size_bytes, segments = 1;
    *message = (struct msghdr){.msg_iov = scratch->out_vectors + begin};
    scratch->out_first[header] = (int32_t)row;
    row = first->next;
    int can_segment = relay->segment && 0 < size_bytes && size_bytes < relay->segment_below;
    while (can_segment && row >= 0 && segments < MOST_SEGMENTS && last_bytes == size_bytes) {
        const departure *other = &scratch->leaving[row];
        if (!may_join(relay, first, other, all_bytes) || end + vectors_of(other) > VECTORS)
            break;
        last_bytes = other->datagram.size_bytes;
        end = add_vectors(relay, begin, end, other);
        all_bytes += last_bytes;
        segments++;
        row = other->next;
    }
    if (segments > 1)
        write_segment_size(message, &scratch->out_controls[header], size_bytes);
    message->msg_iovlen = (size_t)(end - begin);
    write_destination(relay, message, first);
    *vectors = end;
    return row;
}

/* Fill messages from a datagram on; return their number, and the datagram after them. */
static int fill_messages(noack_relay *relay, int64_t row, int64_t *following) {
    relay_scratch *scratch = scratch_of(relay);
    int64_t vectors = 0;
    int headers = 0;
    scratch->joined_bytes = 0;
    while (row >= 0 && headers < LEAVING && vectors + vectors_of(&scratch->leaving[row]) <= VECTORS)
        row = fill_message(relay, headers++, row, &vectors);
    *following = row;
    return headers;
}

/* Wait at most 1 ms until a socket is writable; return the waiting time in ns. */
static int64_t wait_for_room(int fd) {
    int64_t begun_ns = clock_ns(CLOCK_MONOTONIC);
    struct pollfd writable = {.fd = fd, .events = POLLOUT};
    poll(&writable, 1, 1);
    return max_of(clock_ns(CLOCK_MONOTONIC) - begun_ns, 1000);
}

/* Send messages; return the number of those that were sent or failed at once, or -1. */
static int call_send(const noack_relay *relay, int fd, struct mmsghdr *headers, int count) {
    struct msghdr *message = &headers->msg_hdr;
    if (relay->devices)
        return write_packets(fd, headers, count);
    if (count == 1 && message->msg_iovlen == 1 && message->msg_controllen == 0) {
        /* For a single datagram, sendto is cheaper; libc's own also handles thread cancellation. */
        long sent = syscall(
            SYS_sendto, fd, message->msg_iov->iov_base, message->msg_iov->iov_len, MSG_DONTWAIT,
            message->msg_name, message->msg_namelen);
        return sent < 0 ? -1 : 1;
    }
    return sendmmsg(fd, headers, (unsigned)count, MSG_DONTWAIT);
}

static void mark_failed(relay_scratch *scratch, int64_t row, int64_t end, int error) {
    for (; row != end; row = scratch->leaving[row].next)
        scratch->leaving[row].error = error;
}

/* Send a number of messages; return the number of messages that were sent or failed.

   If it is smaller than headers, the kernel does not segment the next message: the headers of the
   remaining datagrams must be filled again. following is the datagram after the last message; -1:
   none. */
static int transmit(noack_relay *relay, int64_t socket, int headers, int64_t following) {
    relay_scratch *scratch = scratch_of(relay);
    int fd = relay->sockets[socket].fd, done = 0, tries = 0;
    int64_t waited_ns = 0;
    while (done < headers) {
        int sent = call_send(relay, fd, &scratch->out_headers[done], headers - done);
        if (sent > 0) {
            done += sent;
            tries = 0;
            continue;
        }
        int error = errno;
        if (error == EINTR)
            continue;
        if (error == EAGAIN && waited_ns < PATIENCE_NS) {
            waited_ns += wait_for_room(fd);
            continue;
        }
        int64_t row = scratch->out_first[done];
        if (error != EAGAIN && error != ENOBUFS) {
            tries++;
            if (tries < (take_errors(relay, socket) > 0 ? MOST_TRIES : TRIES))
                continue;
            const struct msghdr *message = &scratch->out_headers[done].msg_hdr;
            if (message->msg_controllen > 0) {
                relay->segment_below =
                    min_of(relay->segment_below, scratch->leaving[row].datagram.size_bytes);
                return done;
            }
        }
        done++;
        tries = 0;
        mark_failed(scratch, row, done < headers ? scratch->out_first[done] : following, error);
    }
    return done;
}

/* Count a datagram as sent or failed, and free its payload. */
static void account(noack_relay *relay, const departure *leaving, int64_t now_ns) {
    noack_direction *direction = &relay->directions[leaving->datagram.direction];
    if (leaving->error == 0) {
        direction->delays[noack_bucket_of(now_ns - leaving->datagram.arrival_ns)]++;
        if (leaving->delayed)
            direction->lateness[noack_bucket_of(now_ns - leaving->release_ns)]++;
    } else {
        direction->errors[leaving->error & (NOACK_ERRNOS - 1)]++;
    }
    if (leaving->slot >= 0)
        free_payload(relay, leaving->slot);
}

/* Send what is queued for a socket; return the number of calls for that. */
static int64_t send_queued(noack_relay *relay, int32_t place) {
    relay_scratch *scratch = scratch_of(relay);
    const noack_socket *socket = &relay->sockets[place];
    int64_t row = socket->head, following, calls = 0;
    for (; row >= 0; row = following) {
        int headers = fill_messages(relay, row, &following), done = headers;
        if (socket->fd >= 0)
            done = transmit(relay, place, headers, following);
        else
            mark_failed(scratch, row, following, socket->error);
        if (done < headers)
            following = scratch->out_first[done];
        calls++;
    }
    return calls;
}

/* Send all that is queued; return the time afterwards. The clock is read once for several calls. */
int64_t send_all(noack_relay *relay) {
    relay_scratch *scratch = scratch_of(relay);
    int64_t accounted = 0, calls = 0, now_ns = relay->read_ns;
    for (int64_t place = 0; place < scratch->order_count; place++) {
        calls += send_queued(relay, scratch->order[place]);
        if (calls < CALLS_PER_READING && place + 1 < scratch->order_count)
            continue;
        calls = 0;
        now_ns = run_time_ns(&relay->clock);
        for (; accounted <= place; accounted++) {
            noack_socket *socket = &relay->sockets[scratch->order[accounted]];
            socket->is_queued = 0;
            for (int32_t row = socket->head; row >= 0; row = scratch->leaving[row].next)
                account(relay, &scratch->leaving[row], now_ns);
        }
    }
    scratch->order_count = 0;
    scratch->leaving_count = 0;
    return now_ns;
}
