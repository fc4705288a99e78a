/* A peer of the latency benchmark: a bare ping through a bare relay.
 *
 * ping receiver: prints its port, and then the latency of each ping, in ns.
 * ping relay PORT: prints its port, and forwards all datagrams.
 * ping sender PORT COUNT PERIOD_NS: sends a ping, with its time, at every period.
 * A datagram of another size ends the receiver and the relay. With "realtime" as the last argument
 * it locks its memory; all other settings are inherited.
 */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <netinet/in.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

enum { PING_BYTES = 80, MAX_BYTES = 2048, SETTLE_NS = 300000000, NS_PER_S = 1000000000 };

static int64_t now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * NS_PER_S + now.tv_nsec;
}

static void sleep_until(int64_t t_ns)
{
    struct timespec until = {t_ns / NS_PER_S, t_ns % NS_PER_S};
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, NULL);
}

/* A socket on loopback, connected to a port (0: bound to any port, which it prints). */
static int open_socket(int port)
{
    struct sockaddr_in name = {.sin_family = AF_INET, .sin_addr.s_addr = htonl(INADDR_LOOPBACK),
                               .sin_port = htons((uint16_t)port)};
    socklen_t length = sizeof name;
    int fd = socket(AF_INET, SOCK_DGRAM, 0);
    int failed = port ? connect(fd, (struct sockaddr *)&name, length)
                      : bind(fd, (struct sockaddr *)&name, length);
    if (fd < 0 || failed) {
        perror("ping");
        exit(1);
    }
    if (port == 0) {
        getsockname(fd, (struct sockaddr *)&name, &length);
        printf("%d\n", ntohs(name.sin_port));
        fflush(stdout);
    }
    return fd;
}

static void receive(void)
{
    static char data[MAX_BYTES];
    static int64_t latencies_ns[1 << 20];
    int fd = open_socket(0), count = 0;
    while (recv(fd, data, sizeof data, 0) == PING_BYTES && count < 1 << 20) {
        int64_t sent_ns;
        memcpy(&sent_ns, data, sizeof sent_ns);
        latencies_ns[count++] = now_ns() - sent_ns;
    }
    for (int k = 0; k < count; k++)
        printf("%lld\n", (long long)latencies_ns[k]);
}

static void relay(int to)
{
    static char data[MAX_BYTES];
    int in = open_socket(0), out = open_socket(to);
    ssize_t size;
    do {
        size = recv(in, data, sizeof data, 0);
        send(out, data, (size_t)size, 0);
    } while (size == PING_BYTES);
}

static void send_pings(int to, int count, int64_t period_ns)
{
    char data[PING_BYTES] = {0};
    int out = open_socket(to);
    int64_t begin_ns = now_ns() + SETTLE_NS;
    for (int k = 0; k < count; k++) {
        sleep_until(begin_ns + k * period_ns);
        int64_t sent_ns = now_ns();
        memcpy(data, &sent_ns, sizeof sent_ns);
        send(out, data, sizeof data, 0);
    }
    sleep_until(now_ns() + SETTLE_NS);
    send(out, data, 1, 0);
}

int main(int argc, char **argv)
{
    if (argc > 1 && strcmp(argv[argc - 1], "realtime") == 0) {
        mlockall(MCL_CURRENT | MCL_FUTURE);
        argc--;
    }
    if (argc == 2 && strcmp(argv[1], "receiver") == 0)
        receive();
    else if (argc == 3 && strcmp(argv[1], "relay") == 0)
        relay(atoi(argv[2]));
    else if (argc == 5 && strcmp(argv[1], "sender") == 0)
        send_pings(atoi(argv[2]), atoi(argv[3]), atoll(argv[4]));
    else
        return 2;
    return 0;
}
