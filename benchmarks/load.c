/* The load of the relay benchmarks, a shared library that relay_load.py calls.
 *
 * Every datagram begins with its number, a 64-bit integer. Arrival times are the kernel's
 * timestamps (SO_TIMESTAMPNS, CLOCK_REALTIME), which do not depend on when the sink is read.
 * Functions return 0 or an errno.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <linux/sock_diag.h>
#include <netinet/in.h>
#include <signal.h>
#include <stdint.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/wait.h>
#include <time.h>

#include "load.h"

enum { BATCH = 64, DATAGRAM_BYTES = 72, CONTROL_BYTES = 128 };
static const int64_t SECOND_NS = 1000000000;
static const int64_t QUIET_NS = 3000000;
static const int64_t PATIENCE_NS = 300000000; /* after it, the rest of a burst counts as lost */
static const int64_t POLL_NS = 500000;

static int64_t now_ns(clockid_t clock) {
    struct timespec t;
    clock_gettime(clock, &t);
    return t.tv_sec * SECOND_NS + t.tv_nsec;
}

static void sleep_until(int64_t due_ns) {
    struct timespec t = {due_ns / SECOND_NS, due_ns % SECOND_NS};
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, NULL) == EINTR)
        ;
}

struct arrival {
    int64_t number;
    int64_t stamp_ns;
};

/* Receive the datagrams queued at the sink, at most BATCH, without waiting; -1 if there is none. */
static int take(int sink, struct arrival arrivals[BATCH]) {
    static char data[BATCH][DATAGRAM_BYTES];
    static char control[BATCH][CONTROL_BYTES] __attribute__((aligned(16)));
    struct iovec parts[BATCH];
    struct mmsghdr batch[BATCH] = {0};

    for (int k = 0; k < BATCH; k++) {
        parts[k] = (struct iovec){data[k], DATAGRAM_BYTES};
        batch[k].msg_hdr.msg_iov = &parts[k];
        batch[k].msg_hdr.msg_iovlen = 1;
        batch[k].msg_hdr.msg_control = control[k];
        batch[k].msg_hdr.msg_controllen = CONTROL_BYTES;
    }
    int taken = recvmmsg(sink, batch, BATCH, MSG_DONTWAIT, NULL);
    for (int k = 0; k < taken; k++) {
        struct msghdr *head = &batch[k].msg_hdr;
        memcpy(&arrivals[k].number, data[k], sizeof arrivals[k].number);
        arrivals[k].stamp_ns = 0;
        for (struct cmsghdr *c = CMSG_FIRSTHDR(head); c != NULL; c = CMSG_NXTHDR(head, c))
            if (c->cmsg_level == SOL_SOCKET && c->cmsg_type == SCM_TIMESTAMPNS) {
                struct timespec t;
                memcpy(&t, CMSG_DATA(c), sizeof t);
                arrivals[k].stamp_ns = t.tv_sec * SECOND_NS + t.tv_nsec;
            }
    }
    return taken;
}

/* Send the datagrams number first to first + count - 1 as fast as possible; if there are sources
 * (IPv4 addresses in network order), send datagram k from sources[k % n_sources]. */
static int send_all(
    int out, int64_t first, int64_t count, const uint32_t *sources, int64_t n_sources) {
    static char data[BATCH][DATAGRAM_BYTES];
    static char control[BATCH][CMSG_SPACE(sizeof(struct in_pktinfo))] __attribute__((aligned(16)));
    struct iovec parts[BATCH];
    struct mmsghdr batch[BATCH] = {0};

    for (int64_t done = 0; done < count;) {
        int wanted = count - done < BATCH ? (int)(count - done) : BATCH;
        for (int k = 0; k < wanted; k++) {
            int64_t number = first + done + k;
            memcpy(data[k], &number, sizeof number);
            parts[k] = (struct iovec){data[k], DATAGRAM_BYTES};
            batch[k].msg_hdr.msg_iov = &parts[k];
            batch[k].msg_hdr.msg_iovlen = 1;
            if (n_sources > 0) {
                struct in_pktinfo from = {.ipi_spec_dst.s_addr = sources[number % n_sources]};
                struct cmsghdr *c = (struct cmsghdr *)control[k];
                c->cmsg_level = IPPROTO_IP;
                c->cmsg_type = IP_PKTINFO;
                c->cmsg_len = CMSG_LEN(sizeof from);
                memcpy(CMSG_DATA(c), &from, sizeof from);
                batch[k].msg_hdr.msg_control = control[k];
                batch[k].msg_hdr.msg_controllen = sizeof control[k];
            }
        }
        int sent = sendmmsg(out, batch, (unsigned)wanted, 0);
        if (sent < 0 && errno != EINTR)
            return errno;
        done += sent > 0 ? sent : 0;
    }
    return 0;
}

/* Number of bytes that wait at the sink, and its maximum. */
static int64_t waiting(int sink, int64_t *most) {
    uint32_t memory[SK_MEMINFO_VARS] = {0};
    socklen_t length = sizeof memory;
    getsockopt(sink, SOL_SOCKET, SO_MEMINFO, memory, &length);
    *most = memory[SK_MEMINFO_RCVBUF];
    return memory[SK_MEMINFO_RMEM_ALLOC];
}

/* Receive datagrams from number first on. End when datagram count - slack has arrived and none
 * follows, or when none has arrived for PATIENCE_NS. The sink is read when it does not grow or gets
 * full: reading it while the relay writes to it would slow the relay down. */
static void gather(
    int sink, int64_t first, int64_t count, int64_t slack, int64_t begun_ns, struct burst *found) {
    struct arrival arrivals[BATCH];
    int64_t changed_ns = now_ns(CLOCK_MONOTONIC), held_before = 0, most;

    *found = (struct burst){0, -1, 0};
    for (;;) {
        int64_t held = waiting(sink, &most), now = now_ns(CLOCK_MONOTONIC);
        if (held != held_before)
            changed_ns = now;
        if (held == held_before || held > most / 2)
            for (int taken; (taken = take(sink, arrivals)) > 0; held = 0)
                for (int k = 0; k < taken; k++) {
                    int64_t number = arrivals[k].number - first;
                    if (number < 0 || number >= count)
                        continue;
                    found->received++;
                    if (number > found->last) {
                        found->last = number;
                        found->wall_ns = arrivals[k].stamp_ns - begun_ns;
                    }
                }
        held_before = held;
        if (now - changed_ns > (found->last >= count - 1 - slack ? QUIET_NS : PATIENCE_NS))
            return;
        sleep_until(now + POLL_NS);
    }
}

/* Stop a child process, fill its receive buffer, continue it, wait until the buffer is empty. */
int load_burst(
    int out, int sink, int64_t first, int64_t count, int relay, const uint32_t *sources,
    int64_t n_sources, int64_t slack, struct burst *found) {
    siginfo_t info;
    if (kill(relay, SIGSTOP) != 0 || waitid(P_PID, (id_t)relay, &info, WSTOPPED) != 0)
        return errno;
    int failed = send_all(out, first, count, sources, n_sources);
    int64_t begun_ns = now_ns(CLOCK_REALTIME);
    if (kill(relay, SIGCONT) != 0)
        return errno;
    gather(sink, first, count, slack, begun_ns, found);
    return failed;
}

/* Send datagrams one by one, each after the previous one has arrived or timed out (the sink's
 * SO_RCVTIMEO); delay_ns[k] is -1 after a timeout. */
int load_ping(int out, int sink, int64_t first, int64_t count, int64_t *delay_ns) {
    char data[DATAGRAM_BYTES] = {0};
    for (int64_t k = 0; k < count; k++) {
        int64_t number = first + k, found = -1;
        memcpy(data, &number, sizeof number);
        int64_t begun_ns = now_ns(CLOCK_MONOTONIC);
        if (send(out, data, sizeof data, 0) < 0)
            return errno;
        ssize_t taken;
        while (found != number && (taken = recv(sink, data, sizeof data, 0)) >= 0)
            memcpy(&found, data, sizeof found);
        delay_ns[k] = found == number ? now_ns(CLOCK_MONOTONIC) - begun_ns : -1;
    }
    return 0;
}

/* Send a datagram every period_ns, then collect them until all have arrived or none has for
 * PATIENCE_NS; delay_ns of missing datagrams is negative. */
int load_pace(
    int out, int sink, int64_t first, int64_t count, int64_t period_ns, int64_t *delay_ns) {
    char data[DATAGRAM_BYTES] = {0};
    struct arrival arrivals[BATCH];
    int64_t begun_ns = now_ns(CLOCK_MONOTONIC), missing = count;
    for (int64_t k = 0; k < count; k++) {
        int64_t number = first + k;
        memcpy(data, &number, sizeof number);
        sleep_until(begun_ns + (k + 1) * period_ns);
        delay_ns[k] = -now_ns(CLOCK_REALTIME);
        if (send(out, data, sizeof data, 0) < 0)
            return errno;
    }
    int64_t quiet_since_ns = now_ns(CLOCK_MONOTONIC);
    while (missing > 0 && now_ns(CLOCK_MONOTONIC) - quiet_since_ns < PATIENCE_NS) {
        for (int taken; (taken = take(sink, arrivals)) > 0;) {
            for (int k = 0; k < taken; k++) {
                int64_t number = arrivals[k].number - first;
                if (number >= 0 && number < count) {
                    delay_ns[number] += arrivals[k].stamp_ns;
                    missing--;
                }
            }
            quiet_since_ns = now_ns(CLOCK_MONOTONIC);
        }
        sleep_until(now_ns(CLOCK_MONOTONIC) + POLL_NS);
    }
    return 0;
}
