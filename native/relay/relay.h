/* What the files of the relay share. */
#ifndef NOACK_RELAY_H
#define NOACK_RELAY_H

#define _GNU_SOURCE
#include <sys/epoll.h>
#include <sys/socket.h>

#include "../network/network.h"

#pragma GCC visibility push(default)
#include "public.h"
#pragma GCC visibility pop

enum {
    BUFFERS = 128,                    /* datagrams received at once */
    READY = 64,                       /* sockets that one epoll call reports */
    LEAVING = 256,                    /* datagrams that wait to be sent */
    ERRORS = 16,                      /* error-queue messages read at once */
    VECTORS = 1024,                   /* maximum number of vectors in one call */
    FEW_BYTES = 256,                  /* copying them costs less than a vector of their own */
    MOST_BYTES = 65536,               /* no received datagram is longer */
    BUFFER_STRIDE = MOST_BYTES + 256, /* the buffers' first bytes are in different cache sets */
    CONTROL_BYTES = 64,
    ERROR_CONTROL_BYTES = 128 /* timestamp, error, address of the reporter */
};

/* A datagram that is stored, or about to be sent. */
typedef struct noack_slot {
    int64_t packet, arrival_ns, bit;
    int32_t size_bytes;
    int32_t block; /* first block of the payload */
    int32_t direction, client;
    int32_t next; /* next free slot */
    uint8_t copy;
    uint8_t counts; /* 1: it is the first intact copy */
    uint8_t unused[2];
} noack_slot;

typedef struct { /* a datagram that is about to be sent */
    noack_slot datagram;
    const uint8_t *address; /* of the payload, in a receive buffer, unless it has a slot: */
    int64_t release_ns;
    int32_t slot; /* of the stored payload; -1: none */
    int32_t socket, next, error;
    uint8_t delayed, stale;
} departure;

typedef union {
    struct cmsghdr head;
    uint8_t bytes[CONTROL_BYTES];
} control;

typedef union {
    struct cmsghdr head;
    uint8_t bytes[ERROR_CONTROL_BYTES];
} error_control;

typedef struct relay_scratch {
    struct mmsghdr in_headers[BUFFERS], error_headers[ERRORS], out_headers[LEAVING];
    struct iovec in_vectors[BUFFERS], out_vectors[VECTORS];
    uint8_t in_names[BUFFERS][NOACK_NAME_BYTES];
    control in_controls[BUFFERS], out_controls[LEAVING];
    error_control error_controls[ERRORS];
    struct epoll_event ready[READY];
    departure leaving[LEAVING];
    uint8_t joined[LEAVING * FEW_BYTES]; /* payloads of messages that the kernel segments */
    int64_t joined_bytes;
    int32_t out_first[LEAVING]; /* first datagram of each message */
    int32_t order[LEAVING];     /* the sockets that have something to send */
    int64_t order_count;
    int64_t ready_count, ready_next;
    int64_t batch_socket, batch_next, batch_end; /* the receive buffers that are filled */
    int32_t hints[BUFFERS]; /* rows that the senders in the buffers may have; -1: none */
    int64_t leaving_count;
    int64_t arrival_ns;    /* arrival of the datagram in the current receive buffer */
    int64_t real_ns;       /* the real-time clock at the last receiving of datagrams */
    int64_t stamps;        /* 1: the kernel adds arrival timestamps */
    int64_t control_bytes; /* buffer for received control messages; 0: none */
    noack_pauses pauses;   /* work is sending */
    int64_t is_busy;       /* 1: the next datagrams may come together */
    int64_t has_more; /* 1: others may wait: as many as could be were received, or a signal came */
    int64_t due_since_ns; /* since when housekeeping has been due; 0: it is not */
    uint64_t loaded;      /* a sum of what was loaded into the caches, so that it is loaded */
    _Alignas(64) uint8_t buffers[BUFFERS][BUFFER_STRIDE];
} relay_scratch;

static inline relay_scratch *scratch_of(const noack_relay *relay) { return relay->scratch; }

/* The clients' sockets follow those of the links (listening, then sending). */
static inline int64_t socket_of_client(const noack_relay *relay, int64_t client) {
    return 2 * relay->links + client;
}

/* Below 0: the socket is a link's. */
static inline int64_t client_of_socket(const noack_relay *relay, int64_t socket) {
    return socket - 2 * relay->links;
}

/* store.c: delayed datagrams. */
int64_t blocks_for(int64_t size_bytes);
/* Make room for a datagram and its copy, if it is missing and there is memory; return whether there
   is room. */
int make_room(noack_relay *relay, int64_t size_bytes);
uint8_t *block_address(const noack_relay *relay, int64_t block);
int64_t store_payload(noack_relay *relay, const uint8_t *data, noack_slot *datagram);
void free_payload(noack_relay *relay, int64_t slot_number);

/* device.c */
int64_t headers_bytes(const noack_relay *relay);
int read_packets(noack_relay *relay, int64_t socket, int most);
int write_packets(int fd, const struct mmsghdr *headers, int count);

/* clients.c */
int add_clients(noack_relay *relay, int64_t rows);
void touch_clients(noack_relay *relay);
int64_t find_sender(noack_relay *relay);

/* record.c */
int has_room(const noack_relay *relay);
void record_packet(
    noack_relay *relay, int64_t direction, int64_t client, const uint8_t *data,
    const noack_decision *decision);
void record_release(noack_relay *relay, const departure *leaving, int64_t now_ns);

/* send.c */
int64_t send_all(noack_relay *relay);
int64_t take_errors(noack_relay *relay, int64_t socket);

#endif
