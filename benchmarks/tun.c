/* A bare forwarder between two TUN devices: tun INSIDE OUTSIDE, their descriptors, which do not
 * wait. */
#include <errno.h>
#include <poll.h>
#include <stdlib.h>
#include <unistd.h>

int main(int count, char **arguments) {
    static char buffer[65536];
    if (count != 3)
        return 2;
    struct pollfd ends[2] = {
        {.fd = atoi(arguments[1]), .events = POLLIN}, {.fd = atoi(arguments[2]), .events = POLLIN}};
    for (;;) {
        if (poll(ends, 2, -1) < 0 && errno != EINTR)
            return 1;
        for (int i = 0; i < 2; i++)
            for (int k = 0; ends[i].revents && k < 128; k++) {
                ssize_t size = read(ends[i].fd, buffer, sizeof buffer);
                if (size < 0)
                    break;
                if (write(ends[1 - i].fd, buffer, (size_t)size) < 0 && errno != EAGAIN)
                    return 1;
            }
    }
}
