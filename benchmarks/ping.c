/* A peer of the latency benchmark: a ping through a relay, in C, with the settings of a run.
 *
 * ping COUNT PERIOD_NS PRIORITY sends COUNT datagrams of 72 bytes on loopback, one every PERIOD_NS.
 * Sender, relay and receiver are processes; relay and receiver block in recv. Prints the one-way
 * latencies in ns: from the reading of the clock before the sender's send to that after the
 * receiver's recv. PRIORITY is the receiver's SCHED_FIFO priority; with 0
 * the processes have no real-time settings. Standard error names the settings that were refused.
 *
 * ping COUNT PERIOD_NS PRIORITY BURST sends BURST datagrams every PERIOD_NS, as one message that
 * the kernel segments, without a relay and without latencies: the peer of many loops in a run.
 */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#include <inttypes.h>
#include <netinet/in.h>
#include <netinet/udp.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/socket.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

enum { PING_BYTES = 72, MOST_BURST = 64, NS_PER_S = 1000000000, SETTLE_NS = 300000000 };
enum { SENDER = 1, RELAY, RECEIVER }; /* places along the loop: sensor, emulator, controller */

static void require(int succeeded, const char *what) {
    if (!succeeded) {
        perror(what);
        exit(1);
    }
}

static void request(const char *setting, int succeeded) {
    if (!succeeded)
        fprintf(stderr, "%s: not permitted: %s\n", setting, strerror(errno));
}

/* The settings of netem/core/realtime_settings.py. */
static void apply_settings(int priority, int place) {
    if (priority == 0)
        return;
    request("memory_lock", mlockall(MCL_CURRENT | MCL_FUTURE) == 0);
    request("timer_slack", prctl(PR_SET_TIMERSLACK, 1, 0, 0, 0) == 0);
    int rank = priority - RECEIVER + place, number = -1;
    struct sched_param parameters = {.sched_priority = rank > 1 ? rank : 1};
    request("sched_fifo", sched_setscheduler(0, SCHED_FIFO, &parameters) == 0);
    cpu_set_t all, second;
    sched_getaffinity(0, sizeof all, &all);
    for (size_t core = 0; core < CPU_SETSIZE && number < 1; core++) {
        if (CPU_ISSET(core, &all)) {
            CPU_ZERO(&second);
            CPU_SET(core, &second);
            number++;
        }
    }
    request("affinity", number == 1 && sched_setaffinity(0, sizeof second, &second) == 0);
    int32_t longest_us = 0, file = open("/dev/cpu_dma_latency", O_WRONLY); /* stays open */
    request("cpu_dma_latency", file >= 0 && write(file, &longest_us, sizeof longest_us) > 0);
}

static int64_t now_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * NS_PER_S + now.tv_nsec;
}

static void sleep_until(int64_t t_ns) {
    struct timespec until = {.tv_sec = t_ns / NS_PER_S, .tv_nsec = t_ns % NS_PER_S};
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, NULL) == EINTR)
        ;
}

static int udp_socket(void) {
    struct sockaddr_in address = {.sin_family = AF_INET};
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    int endpoint = socket(AF_INET, SOCK_DGRAM, 0);
    require(
        endpoint >= 0 && bind(endpoint, (struct sockaddr *)&address, sizeof address) == 0, "bind");
    return endpoint;
}

static void connect_to(int from, int to) {
    struct sockaddr_in address;
    socklen_t size = sizeof address;
    getsockname(to, (struct sockaddr *)&address, &size);
    require(connect(from, (struct sockaddr *)&address, size) == 0, "connect");
}

static void relay(int in, int out) {
    char data[PING_BYTES];
    for (ssize_t size = 1; size > 0;) { /* an empty datagram ends a process */
        size = recv(in, data, sizeof data, 0);
        send(out, data, (size_t)size, 0);
    }
}

static void receive(int in, long count) {
    int64_t data[PING_BYTES / 8], *latencies_ns = calloc((size_t)count, sizeof *latencies_ns);
    long received = 0;
    require(latencies_ns != NULL, "calloc");
    while (recv(in, data, sizeof data, 0) > 0 && received < count)
        latencies_ns[received++] = now_ns() - data[0];
    for (long k = 0; k < received; k++)
        printf("%" PRId64 "\n", latencies_ns[k]);
    require(fflush(stdout) == 0, "write");
}

static void receive_bursts(int in, long expected) {
    static char data[MOST_BURST][PING_BYTES];
    struct iovec parts[MOST_BURST];
    struct mmsghdr batch[MOST_BURST] = {0};
    int bytes = 4 * 1024 * 1024;
    long received = 0;
    setsockopt(in, SOL_SOCKET, SO_RCVBUFFORCE, &bytes, sizeof bytes);
    for (int k = 0; k < MOST_BURST; k++) {
        parts[k] = (struct iovec){data[k], PING_BYTES};
        batch[k].msg_hdr = (struct msghdr){.msg_iov = &parts[k], .msg_iovlen = 1};
    }
    int taken;
    do {
        taken = recvmmsg(in, batch, MOST_BURST, MSG_WAITFORONE, NULL);
        received += taken;
    } while (taken > 0 && batch[taken - 1].msg_len > 0); /* the last datagram is empty */
    errno = ENOBUFS;
    require(received == expected + 1, "receive");
}

static void send_bursts(int out, long count, int64_t period_ns, int burst) {
    static char data[MOST_BURST * PING_BYTES];
    int segment_bytes = PING_BYTES;
    int64_t begin_ns = now_ns() + SETTLE_NS;
    require(
        setsockopt(out, IPPROTO_UDP, UDP_SEGMENT, &segment_bytes, sizeof segment_bytes) == 0,
        "UDP_SEGMENT");
    for (long number = 0; number < count; number++) {
        sleep_until(begin_ns + number * period_ns);
        send(out, data, (size_t)burst * PING_BYTES, 0);
    }
    sleep_until(now_ns() + SETTLE_NS);
    send(out, data, 0, 0);
}

static void send_all(int out, long count, int64_t period_ns) {
    int64_t data[PING_BYTES / 8] = {0}, begin_ns = now_ns() + SETTLE_NS;
    for (long number = 0; number < count; number++) {
        sleep_until(begin_ns + number * period_ns);
        data[0] = now_ns();
        send(out, data, sizeof data, 0);
    }
    sleep_until(now_ns() + SETTLE_NS);
    send(out, data, 0, 0);
}

int main(int argc, char **argv) {
    int burst = argc == 5 ? atoi(argv[4]) : 0;
    errno = EINVAL;
    require(
        (argc == 4 || burst > 0) && burst <= MOST_BURST, "ping COUNT PERIOD_NS PRIORITY [BURST]");
    long count = atol(argv[1]);
    int64_t period_ns = atoll(argv[2]);
    int priority = atoi(argv[3]), failed = 0;
    int receiver_in = udp_socket(), relay_in = udp_socket(), relay_out = udp_socket();
    int sender_out = udp_socket();
    connect_to(relay_out, receiver_in);
    connect_to(sender_out, burst ? receiver_in : relay_in);
    for (int place = RECEIVER; place >= SENDER; place--) {
        if (burst && place == RELAY)
            continue;
        pid_t child = fork();
        require(child >= 0, "fork");
        if (child > 0)
            continue;
        apply_settings(priority, place);
        if (place == RECEIVER && burst)
            receive_bursts(receiver_in, count * burst);
        else if (place == RECEIVER)
            receive(receiver_in, count);
        else if (place == RELAY)
            relay(relay_in, relay_out);
        else if (burst)
            send_bursts(sender_out, count, period_ns, burst);
        else
            send_all(sender_out, count, period_ns);
        return 0;
    }
    for (int status; wait(&status) > 0;)
        failed |= status != 0;
    return failed;
}
