/* The sockets of the live driver: datagrams are received and sent in groups. */
#include "driver.h"

#include <errno.h>
#include <netinet/udp.h>
#include <stddef.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/timerfd.h>
#include <unistd.h>

static void renew_header(driver_scratch *scratch, int64_t k) {
    scratch->in_headers[k].msg_hdr.msg_namelen = NOACK_NAME_BYTES;
    scratch->in_headers[k].msg_hdr.msg_control = &scratch->in_controls[k];
    scratch->in_headers[k].msg_hdr.msg_controllen = sizeof scratch->in_controls[k];
}

/* Let epoll report a file that can be read by a bit; return 0 or errno. */
static int64_t watch(const noack_driver *driver, int64_t fd, uint64_t bit) {
    struct epoll_event event = {.events = EPOLLIN, .data.u64 = bit};
    return epoll_ctl((int)driver->epoll, EPOLL_CTL_ADD, (int)fd, &event) == 0 ? 0 : errno;
}

int64_t noack_driver_open(noack_driver *driver) {
    driver_scratch *scratch = scratch_of(driver);
    for (int k = 0; k < BUFFERS; k++) {
        scratch->out_vectors[k] = (struct iovec){scratch->out_data[k], 0};
        scratch->out_headers[k].msg_hdr =
            (struct msghdr){.msg_iov = &scratch->out_vectors[k], .msg_iovlen = 1};
    }
    for (int k = 0; k < MESSAGES; k++) {
        scratch->in_vectors[k] = (struct iovec){scratch->in_data[k], MESSAGE_BYTES};
        scratch->in_headers[k].msg_hdr = (struct msghdr){
            .msg_name = scratch->in_names[k], .msg_iov = &scratch->in_vectors[k], .msg_iovlen = 1};
        renew_header(scratch, k);
    }
    /* A call that has received as many as it may does not look for another one. */
    scratch->batch = min_of(driver->process->loops, MESSAGES - 1);
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

int is_peer(const uint8_t name[NOACK_NAME_BYTES], const noack_peer *peer) {
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
    driver_scratch *scratch = scratch_of(driver);
    uint8_t *place = scratch->in_data[MESSAGES - 1];
    size_bytes = min_of(size_bytes, BUFFER_BYTES);
    memcpy(place, data, (size_t)size_bytes);
    memcpy(scratch->in_names[MESSAGES - 1], name, NOACK_NAME_BYTES);
    if (scratch->in_next == scratch->in_end)
        scratch->in_next = scratch->in_end = 0;
    scratch->arrivals[scratch->in_end++] =
        (arrival){place, size_bytes, scratch->in_names[MESSAGES - 1], 0};
}

/* Send datagrams of one size as one message, which goes through the kernel once. Return their
   number, or -1 if that fails: the network's interface may refuse such messages. */
static int send_segmented(driver_scratch *scratch, int fd, int64_t place, int64_t count) {
    uint16_t size = (uint16_t)scratch->out_vectors[place].iov_len;
    control size_control = {
        .head = {
            .cmsg_level = IPPROTO_UDP,
            .cmsg_type = UDP_SEGMENT,
            .cmsg_len = CMSG_LEN(sizeof size)}};
    memcpy(CMSG_DATA(&size_control.head), &size, sizeof size);
    struct msghdr message = {
        .msg_iov = &scratch->out_vectors[place],
        .msg_iovlen = (size_t)count,
        .msg_control = &size_control,
        .msg_controllen = CMSG_SPACE(sizeof size)};
    if (sendmsg(fd, &message, MSG_DONTWAIT) >= 0)
        return (int)count;
    scratch->is_unsegmented = errno == EINVAL || errno == EIO || errno == EMSGSIZE;
    return -1;
}

/* Send datagrams of one socket, from a place on; return how many were sent, or -1. */
static int call_send(driver_scratch *scratch, int fd, int64_t place, int64_t count) {
    const struct iovec *vectors = &scratch->out_vectors[place];
    int64_t equal = 1;
    while (equal < count && vectors[equal].iov_len == vectors[0].iov_len)
        equal++;
    if (equal > 1 && !scratch->is_unsegmented) {
        int sent = send_segmented(scratch, fd, place, equal);
        if (sent > 0 || !scratch->is_unsegmented)
            return sent;
    }
    if (count > 1)
        return sendmmsg(fd, &scratch->out_headers[place], (unsigned)count, MSG_DONTWAIT);
    const struct iovec *vector = &scratch->out_vectors[place];
    return send(fd, vector->iov_base, vector->iov_len, MSG_DONTWAIT) < 0 ? -1 : 1;
}

void send_datagrams(noack_driver *driver) {
    driver_scratch *scratch = scratch_of(driver);
    int has_failed = 0;
    for (int64_t k = 0, end; k < scratch->out_count;) {
        for (end = k + 1;
             end < scratch->out_count && scratch->out_flows[end] == scratch->out_flows[k];)
            end++;
        int sent = call_send(scratch, (int)driver->senders[scratch->out_flows[k]], k, end - k);
        if (sent > 0) {
            driver->sent += sent;
            k += sent;
            has_failed = 0;
        } else if (errno != EINTR && !has_failed) {
            has_failed = 1;
        } else if (errno != EINTR) {
            driver->errors[errno & (NOACK_ERRNOS - 1)]++;
            k++;
            has_failed = 0;
        }
    }
    scratch->out_count = scratch->sealed_count = 0;
}

/* Receive at most a number of messages from a place on; return their number. After an ICMP error of
   a datagram, it fails once. Of several loops, a message may have several datagrams. */
static int64_t call_receive(driver_scratch *scratch, int fd, int64_t place, int64_t most) {
    if (scratch->batch > 1)
        return recvmmsg(fd, &scratch->in_headers[place], (unsigned)most, MSG_DONTWAIT, NULL);
    socklen_t name_bytes = NOACK_NAME_BYTES;
    ssize_t size_bytes = recvfrom(
        fd, scratch->in_data[place], BUFFER_BYTES, MSG_DONTWAIT,
        (struct sockaddr *)scratch->in_names[place], &name_bytes);
    scratch->in_headers[place].msg_len = (unsigned)max_of(size_bytes, 0);
    scratch->in_headers[place].msg_hdr.msg_controllen = 0;
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

void take_datagrams(noack_driver *driver) {
    driver_scratch *scratch = scratch_of(driver);
    scratch->in_next = scratch->in_end = 0;
    /* One place is left for a datagram that Python adds. */
    while (scratch->message_next < scratch->message_end && scratch->in_end < BUFFERS - 1) {
        int64_t message = scratch->message_next, all_bytes = scratch->in_headers[message].msg_len;
        int64_t size_bytes =
            min_of(segment_bytes(&scratch->in_headers[message]), all_bytes - scratch->taken_bytes);
        const uint8_t *name = scratch->in_names[message];
        scratch->arrivals[scratch->in_end++] =
            (arrival){scratch->in_data[message] + scratch->taken_bytes, size_bytes, name, 0};
        scratch->taken_bytes += size_bytes;
        int64_t source = 0;
        while (source < 2 && !is_peer(name, &driver->sources[source]))
            source++;
        if (source < 2)
            driver->sources[source].received++;
        else
            driver->unknown_source++;
        if (scratch->taken_bytes == all_bytes) {
            renew_header(scratch, message);
            scratch->taken_bytes = 0;
            scratch->message_next++;
        }
    }
    if (!driver->wire.encrypted)
        compare_tags(driver);
}

void receive_datagrams(noack_driver *driver, int64_t ready) {
    driver_scratch *scratch = scratch_of(driver);
    scratch->message_next = scratch->message_end = scratch->taken_bytes = scratch->has_more = 0;
    for (int64_t turn = 0; turn < driver->receiver_count; turn++) {
        int64_t k = (scratch->first + turn) % driver->receiver_count;
        int64_t most = min_of(scratch->batch, MESSAGES - 1 - scratch->message_end);
        if (!(ready >> k & 1) || most == 0)
            continue;
        int64_t received =
            call_receive(scratch, (int)driver->receivers[k], scratch->message_end, most);
        scratch->message_end += max_of(received, 0);
        scratch->has_more |= received == most;
    }
    scratch->first ^= 1;
    take_datagrams(driver);
}
