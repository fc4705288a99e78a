/* At most two datagrams in a row are lost between a sender and a receiver. */
#define _POSIX_C_SOURCE 200809L
#include <arpa/inet.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <sys/wait.h>
#include <unistd.h>

enum { DATAGRAMS = 100, MOST_IN_A_ROW = 2, PATIENCE_S = 60 };

static void fail(const char *what) {
    perror(what);
    exit(1);
}

/* A socket on a free port of the loopback interface, and the port. */
static int open_socket(int *port) {
    struct sockaddr_in address = {.sin_family = AF_INET, .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
    socklen_t size = sizeof address;
    int opened = socket(AF_INET, SOCK_DGRAM, 0);
    struct timeval patience = {.tv_sec = PATIENCE_S};
    if (opened < 0 || bind(opened, (struct sockaddr *)&address, size) ||
        getsockname(opened, (struct sockaddr *)&address, &size) ||
        setsockopt(opened, SOL_SOCKET, SO_RCVTIMEO, &patience, sizeof patience))
        fail("socket");
    *port = ntohs(address.sin_port);
    return opened;
}

/* Start the emulator in front of a port; `output` becomes its standard output. */
static pid_t start_emulator(int to_port, FILE **output) {
    int ends[2];
    char to[32];
    snprintf(to, sizeof to, "127.0.0.1:%d", to_port);
    if (pipe(ends)) fail("pipe");
    pid_t started = fork();
    if (started < 0) fail("fork");
    if (started == 0) {
        dup2(ends[1], STDOUT_FILENO);
        close(ends[0]);
        execlp(
            "noack-netem", "noack-netem", "--listen", "127.0.0.1:0", "--to", to, "--json", "loss",
            "50%", "mansd", "2", (char *)NULL);
        fail("noack-netem");
    }
    close(ends[1]);
    *output = fdopen(ends[0], "r");
    return started;
}

/* The port in {"ready": [{"name": "relay", "listen": "127.0.0.1:40123", "to": ...}]}. */
static int port_of(const char *line) {
    const char *found = strstr(line, "\"listen\": \"127.0.0.1:");
    if (!found) {
        fprintf(stderr, "not ready: %s\n", line);
        exit(1);
    }
    return atoi(found + strlen("\"listen\": \"127.0.0.1:"));
}

int main(void) {
    static char line[65536];
    FILE *output;
    int port, unused, status, last = -1;
    int receiver = open_socket(&port), sender = open_socket(&unused);
    pid_t emulator = start_emulator(port, &output);
    if (!fgets(line, sizeof line, output)) fail("the emulator has ended");
    struct sockaddr_in to = {.sin_family = AF_INET, .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
    to.sin_port = htons((unsigned short)port_of(line));

    for (int number = 0; number < DATAGRAMS; number++)
        if (sendto(sender, &number, sizeof number, 0, (struct sockaddr *)&to, sizeof to) < 0)
            fail("sendto");
    while (last < DATAGRAMS - 1 - MOST_IN_A_ROW) { /* one of the last three arrives */
        int number;
        if (recv(receiver, &number, sizeof number, 0) != (ssize_t)sizeof number) fail("recv");
        if (number - last - 1 > MOST_IN_A_ROW) {
            fprintf(stderr, "%d datagrams in a row are missing\n", number - last - 1);
            return 1;
        }
        last = number;
    }

    kill(emulator, SIGINT);
    while (fgets(line, sizeof line, output)) fputs(line, stdout); /* the totals, as JSON */
    waitpid(emulator, &status, 0);
    if (!WIFEXITED(status) || WEXITSTATUS(status)) {
        fprintf(stderr, "the emulator lost datagrams that it should not lose (status 3), or failed\n");
        return 1;
    }
    return 0;
}
