/* Packets of TUN devices, which have neither addresses nor messages: they are read and written one
   by one, and their flows are read from their headers.

   Sources: RFC 791, RFC 8200 (extension headers: section 4), RFC 792 and RFC 4443 (echo). */
#include "relay.h"

#include <errno.h>
#include <netinet/in.h>
#include <string.h>
#include <sys/uio.h>
#include <unistd.h>

enum {
    IPV4_BYTES = 20,
    IPV6_BYTES = 40,
    MOST_EXTENSIONS = 8,
    /* Places in the name of a flow; near: the end inside the shell. */
    VERSION = 0,
    PROTOCOL = 1,
    IS_FRAGMENT = 2,
    NEAR_PORT = 4,
    FAR_PORT = 6,
    NEAR_HOST = 8,
    FAR_HOST = 24
};

/* The bytes of a packet before what a UDP payload would be; 0 for datagrams of sockets. */
int64_t headers_bytes(const noack_relay *relay) { return relay->devices ? NOACK_HEADERS_BYTES : 0; }

/* Skip the extension headers of IPv6, from next_header on; return where the transport's begins. */
static int64_t skip_extensions(const uint8_t *packet, int64_t size_bytes, uint8_t *name) {
    int64_t at = IPV6_BYTES;
    uint8_t next = packet[6];
    for (int k = 0; k < MOST_EXTENSIONS && at + 8 <= size_bytes; k++) {
        if (next != IPPROTO_HOPOPTS && next != IPPROTO_ROUTING && next != IPPROTO_DSTOPTS
            && next != IPPROTO_FRAGMENT)
            break;
        int64_t length = 8 + 8 * (int64_t)packet[at + 1];
        if (next == IPPROTO_FRAGMENT) {
            length = 8;
            /* A packet with this header may be whole (RFC 6946). */
            name[IS_FRAGMENT] = (packet[at + 2] | (packet[at + 3] & 0xF9)) != 0;
        }
        next = packet[at];
        at += length;
    }
    name[PROTOCOL] = next;
    return at;
}

/* Write the ports, or the identifier of an echo as that of the near end. */
static void read_ports(const uint8_t *header, int64_t left_bytes, int reverse, uint8_t *name) {
    switch (name[PROTOCOL]) {
    case IPPROTO_TCP:
    case IPPROTO_UDP:
    case IPPROTO_UDPLITE:
    case IPPROTO_SCTP:
    case IPPROTO_DCCP:
        if (left_bytes >= 4) {
            memcpy(name + (reverse ? FAR_PORT : NEAR_PORT), header, 2);
            memcpy(name + (reverse ? NEAR_PORT : FAR_PORT), header + 2, 2);
        }
        break;
    case IPPROTO_ICMP:
        if (left_bytes >= 8 && (header[0] == 0 || header[0] == 8))
            memcpy(name + NEAR_PORT, header + 4, 2);
        break;
    case IPPROTO_ICMPV6:
        if (left_bytes >= 8 && (header[0] == 128 || header[0] == 129))
            memcpy(name + NEAR_PORT, header + 4, 2);
        break;
    default:
        break;
    }
}

/* Write the name of a packet's flow. All fragments between two hosts are one flow of a protocol, as
   only the first has ports. All packets that are not of IP are one flow. */
static void read_flow(const uint8_t *packet, int64_t size_bytes, int reverse, uint8_t *name) {
    memset(name, 0, NOACK_NAME_BYTES);
    int64_t at = 0, near = reverse ? FAR_HOST : NEAR_HOST, far = reverse ? NEAR_HOST : FAR_HOST;
    if (size_bytes >= IPV4_BYTES && packet[0] >> 4 == 4) {
        name[VERSION] = 4;
        name[PROTOCOL] = packet[9];
        name[IS_FRAGMENT] = (packet[6] & 0x3F) != 0 || packet[7] != 0;
        memcpy(name + near, packet + 12, 4);
        memcpy(name + far, packet + 16, 4);
        at = 4 * (int64_t)(packet[0] & 0x0F);
    } else if (size_bytes >= IPV6_BYTES && packet[0] >> 4 == 6) {
        name[VERSION] = 6;
        memcpy(name + near, packet + 8, 16);
        memcpy(name + far, packet + 24, 16);
        at = skip_extensions(packet, size_bytes, name);
    } else {
        return;
    }
    if (!name[IS_FRAGMENT])
        read_ports(packet + at, size_bytes - at, reverse, name);
}

/* Whether a packet is for several receivers. The kernel itself sends some, which would be flows. */
static int is_multicast(const uint8_t *packet, int64_t size_bytes) {
    if (size_bytes >= IPV4_BYTES && packet[0] >> 4 == 4)
        return packet[16] >> 4 == 0xE;
    return size_bytes >= IPV6_BYTES && packet[0] >> 4 == 6 && packet[24] == 0xFF;
}

/* Read at most some packets into the free buffers; return their number, or -1. Packets for several
   receivers are discarded. */
int read_packets(noack_relay *relay, int64_t socket, int most) {
    relay_scratch *scratch = scratch_of(relay);
    int64_t begin = scratch->batch_end;
    int packet_count = 0, fd = relay->sockets[socket].fd;
    while (packet_count < most) {
        int64_t k = begin + packet_count;
        ssize_t size_bytes = read(fd, scratch->buffers[k], MOST_BYTES);
        if (size_bytes < 0)
            break;
        if (is_multicast(scratch->buffers[k], size_bytes))
            continue;
        packet_count++;
        scratch->in_headers[k].msg_len = (unsigned)size_bytes;
        scratch->in_headers[k].msg_hdr.msg_controllen = 0;
        read_flow(scratch->buffers[k], size_bytes, socket != 0, scratch->in_names[k]);
    }
    return packet_count > 0 ? packet_count : -1;
}

/* Write packets; return the number of those written before the first that failed, or -1. */
int write_packets(int fd, const struct mmsghdr *headers, int count) {
    for (int k = 0; k < count; k++) {
        const struct msghdr *message = &headers[k].msg_hdr;
        const struct iovec *first = message->msg_iov;
        ssize_t written = message->msg_iovlen == 1 ? write(fd, first->iov_base, first->iov_len)
                                                   : writev(fd, first, (int)message->msg_iovlen);
        if (written < 0)
            return k > 0 ? k : -1;
    }
    return count;
}
