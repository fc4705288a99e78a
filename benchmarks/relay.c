/* A peer of the relay benchmarks: a relay that only forwards.
 *
 * Receives up to 64 datagrams with one recvmmsg and sends them with one sendmmsg through a
 * connected socket, to one destination on loopback. With "segment", successive datagrams of equal
 * size are sent as one message, which the kernel segments (UDP_SEGMENT). With "names", it also
 * receives the sources' addresses, and ignores them. With "paths", each source has a connected
 * socket of its own, which the last 16 bits of its address select, and whose answers go back to the
 * source: as in our relay, epoll waits for them.
 */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <errno.h>
#include <netinet/in.h>
#include <netinet/udp.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/resource.h>
#include <sys/socket.h>

enum { BATCH = 64, MAX_BYTES = 2048, BUFFER_BYTES = 4 * 1024 * 1024 };

static void fail(const char *what) {
    perror(what);
    exit(1);
}

static char data[BATCH][MAX_BYTES];
static struct iovec parts[BATCH];
static struct mmsghdr batch[BATCH];

static void forward(int out, int count) {
    for (int sent = 0; sent < count;) {
        int n = sendmmsg(out, batch + sent, (unsigned)(count - sent), 0);
        sent += n > 0 ? n : 1; /* a refused datagram (port unreachable) is lost */
    }
}

static void forward_segments(int out, int count) {
    for (int first = 0, next; first < count; first = next) {
        uint16_t size = (uint16_t)parts[first].iov_len;
        for (next = first + 1; next < count && parts[next].iov_len == size;)
            next++;
        char control[CMSG_SPACE(sizeof size)] __attribute__((aligned(8))) = {0};
        struct msghdr run = {
            .msg_iov = &parts[first],
            .msg_iovlen = (size_t)(next - first),
            .msg_control = control,
            .msg_controllen = sizeof control};
        struct cmsghdr *c = CMSG_FIRSTHDR(&run);
        c->cmsg_level = IPPROTO_UDP;
        c->cmsg_type = UDP_SEGMENT;
        c->cmsg_len = CMSG_LEN(sizeof size);
        memcpy(CMSG_DATA(c), &size, sizeof size);
        if (sendmsg(out, &run, 0) < 0 && errno != ECONNREFUSED)
            fail("sendmsg");
    }
}

static struct sockaddr_in names[BATCH];
static struct sockaddr_in clients[1 << 16]; /* the addresses of the sources with a socket */

/* The socket of the source of datagram k; the first time, open it and wait for its answers, too. */
static int path_of(int k, int epoll, const struct sockaddr_in *server) {
    static int paths[1 << 16];
    uint32_t number = ntohl(names[k].sin_addr.s_addr) & 0xffff;
    int *path = &paths[number];
    if (*path == 0) {
        *path = socket(AF_INET, SOCK_DGRAM, 0);
        if (*path < 0 || connect(*path, (const struct sockaddr *)server, sizeof *server) != 0)
            fail("path");
        struct epoll_event answers = {
            .events = EPOLLIN, .data.u64 = (uint64_t)number << 32 | (uint32_t)*path};
        if (epoll_ctl(epoll, EPOLL_CTL_ADD, *path, &answers) != 0)
            fail("epoll_ctl");
        clients[number] = names[k];
    }
    return *path;
}

static void forward_paths(int epoll, const struct sockaddr_in *server, int count) {
    for (int k = 0; k < count; k++)
        batch[k].msg_hdr.msg_name = NULL;
    for (int first = 0, next; first < count; first = next) {
        int path = path_of(first, epoll, server);
        for (next = first + 1; next < count && path_of(next, epoll, server) == path;)
            next++;
        if (next - first == 1)
            send(path, parts[first].iov_base, parts[first].iov_len, 0);
        else
            sendmmsg(path, batch + first, (unsigned)(next - first), 0);
    }
}

/* Receive up to BATCH datagrams; return their number. */
static int receive(int in, int flags, bool with_names) {
    for (int k = 0; k < BATCH; k++) {
        parts[k].iov_len = MAX_BYTES;
        batch[k].msg_hdr.msg_name = with_names ? &names[k] : NULL;
        batch[k].msg_hdr.msg_namelen = with_names ? sizeof names[k] : 0;
    }
    int taken = recvmmsg(in, batch, BATCH, flags, NULL);
    if (taken < 0 && errno != EINTR && errno != EAGAIN && errno != ECONNREFUSED)
        fail("recvmmsg");
    for (int k = 0; k < taken; k++)
        parts[k].iov_len = batch[k].msg_len;
    return taken;
}

/* Forward by a socket for each client, and return the answers. */
static void relay_paths(int in, const struct sockaddr_in *server) {
    int epoll = epoll_create1(0);
    struct epoll_event listening = {.events = EPOLLIN, .data.u64 = (uint32_t)in}, ready[BATCH];
    if (epoll < 0 || epoll_ctl(epoll, EPOLL_CTL_ADD, in, &listening) != 0)
        fail("epoll");
    for (;;) {
        int count = epoll_wait(epoll, ready, BATCH, -1);
        for (int i = 0; i < count; i++) {
            int from = (int)(uint32_t)ready[i].data.u64;
            int taken = receive(from, MSG_DONTWAIT, from == in);
            if (from == in) {
                forward_paths(epoll, server, taken);
                continue;
            }
            for (int k = 0; k < taken; k++) {
                batch[k].msg_hdr.msg_name = &clients[ready[i].data.u64 >> 32];
                batch[k].msg_hdr.msg_namelen = sizeof clients[0];
            }
            if (taken > 0)
                forward(in, taken);
        }
    }
}

int main(int argc, char **argv) {
    struct sockaddr_in here = {.sin_family = AF_INET, .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
    struct sockaddr_in there = here;
    int in = socket(AF_INET, SOCK_DGRAM, 0), out = socket(AF_INET, SOCK_DGRAM, 0);
    int bytes = BUFFER_BYTES;
    bool segment = false, by_path = false, with_names = false;
    struct rlimit files;

    for (int k = 3; k < argc; k++) {
        segment |= strcmp(argv[k], "segment") == 0;
        by_path |= strcmp(argv[k], "paths") == 0;
        with_names |= strcmp(argv[k], "names") == 0;
    }
    if (argc < 3) {
        fprintf(stderr, "usage: %s FROM TO [segment] [names] | FROM TO paths\n", argv[0]);
        return 2;
    }
    if (getrlimit(RLIMIT_NOFILE, &files) == 0) {
        files.rlim_cur = files.rlim_max;
        setrlimit(RLIMIT_NOFILE, &files);
    }
    here.sin_port = htons((uint16_t)atoi(argv[1]));
    there.sin_port = htons((uint16_t)atoi(argv[2]));
    if (setsockopt(in, SOL_SOCKET, SO_RCVBUFFORCE, &bytes, sizeof bytes) != 0)
        setsockopt(in, SOL_SOCKET, SO_RCVBUF, &bytes, sizeof bytes);
    if (bind(in, (struct sockaddr *)&here, sizeof here) != 0)
        fail("bind");
    if (connect(out, (struct sockaddr *)&there, sizeof there) != 0)
        fail("connect");

    for (int k = 0; k < BATCH; k++) {
        parts[k].iov_base = data[k];
        batch[k].msg_hdr.msg_iov = &parts[k];
        batch[k].msg_hdr.msg_iovlen = 1;
    }
    if (by_path)
        relay_paths(in, &there);
    for (;;) {
        int taken = receive(in, MSG_WAITFORONE, with_names);
        for (int k = 0; k < taken; k++)
            batch[k].msg_hdr.msg_name = NULL; /* sent to where the socket is connected */
        if (segment)
            forward_segments(out, taken);
        else
            forward(out, taken);
    }
}
