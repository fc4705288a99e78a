/* The memory of the live driver, and the functions of its sockets. */
#ifndef NOACK_DRIVER_H
#define NOACK_DRIVER_H

#define _GNU_SOURCE
#include "channel.h"

#include <netinet/in.h>
#include <sys/socket.h>

enum {
    BUFFERS = 64, /* datagrams that are handled or sent at once; the kernel segments as many */
    BUFFER_BYTES = 576, /* a longer datagram is cut, and rejected by its length */
    MESSAGES = 16,      /* received at once; the last place is for a datagram that Python adds */
    MESSAGE_BYTES = BUFFERS * BUFFER_BYTES /* a message of the kernel has several datagrams */
};

typedef union { /* room for the size of the datagrams in a message */
    struct cmsghdr head;
    uint8_t bytes[CMSG_SPACE(sizeof(int))];
} control;

typedef struct { /* a datagram that was received */
    uint8_t *data;
    int64_t size_bytes;
    const uint8_t *name;
    int has_tag; /* 1: its tag has been found right */
} arrival;

typedef struct driver_scratch {
    struct mmsghdr in_headers[MESSAGES], out_headers[BUFFERS];
    struct iovec in_vectors[MESSAGES], out_vectors[BUFFERS];
    control in_controls[MESSAGES];
    uint8_t in_names[MESSAGES][NOACK_NAME_BYTES];
    int64_t message_next, message_end; /* the messages of which datagrams are still to be taken */
    int64_t taken_bytes;               /* of the next one */
    arrival arrivals[BUFFERS];
    int64_t in_next, in_end; /* the current datagram, and the end of those taken */
    int64_t is_unsegmented;  /* 1: the kernel does not segment what this process sends */
    int64_t out_count, sealed_count;
    int64_t is_sealing;        /* 1: Python encrypts what waits to be sent */
    int64_t reason;            /* why the driver returns then */
    int64_t is_accepted;       /* 1: the current datagram has become the message */
    int64_t is_ticking;        /* 1: a tick waits for room for its rows */
    int64_t now_ns;            /* time of the message or tick */
    int64_t batch;             /* datagrams that one call receives */
    int64_t timer_ns;          /* when the timer expires, on the monotonic clock */
    int8_t out_flows[BUFFERS]; /* the sockets of what waits to be sent */
    noack_pauses pauses;
    int64_t has_more; /* 1: a socket may have more datagrams than were received */
    int64_t first;    /* the socket that is read first the next time */
    noack_message message;
    uint8_t out_data[BUFFERS][BUFFER_BYTES];
    uint8_t in_data[MESSAGES][MESSAGE_BYTES];
} driver_scratch;

static inline driver_scratch *scratch_of(const noack_driver *driver) { return driver->scratch; }

/* four_tags.c: the tags of datagrams with the same number of bytes of content, a multiple of 8. */
enum { FOUR = 4, MOST_TAGGED_BYTES = 128 };
void tag_four(
    const noack_wire *wire, int64_t content_bytes, uint8_t *const datagrams[FOUR],
    uint64_t tags[FOUR][NOACK_TAG_BYTES / 8]);

/* tags.c: the tags of what waits to be sent; and whether the datagrams that were taken have the
   right one, where four are compared at once. The others are compared when they are examined. */
void write_tags(noack_driver *driver);
void compare_tags(noack_driver *driver);

/* sockets.c */

/* Whether a name is that of a peer: the same family, port and host. */
int is_peer(const uint8_t name[NOACK_NAME_BYTES], const noack_peer *peer);

/* Send the datagrams that wait; a failure is counted. An ICMP error of an earlier datagram makes
   one call fail, too, so each is tried twice. */
void send_datagrams(noack_driver *driver);

/* Receive messages from the sockets that have some. They are read first in turn: one that always
   has many would leave no room for the other. */
void receive_datagrams(noack_driver *driver, int64_t ready);

/* Take datagrams out of the messages that were received, and count their sources. */
void take_datagrams(noack_driver *driver);

#endif
