/* The emulator with sockets. */

/* ---- The relay: waits for, receives, decides, sends ------------------------------------------ */

enum {
    NOACK_HEADERS_BYTES = 28,  /* of IPv4 and UDP; what follows in a packet is its payload */
    NOACK_BLOCK_BYTES = 512,   /* payloads of delayed datagrams are kept in chained blocks */
    NOACK_CHUNK_BLOCKS = 4096, /* number of blocks per allocation */
    NOACK_BUCKETS = 1280       /* of a histogram of times; the last one also has all from 4.8 hours on */
};

/* Why the relay returned; the last two occur within it only. */
enum noack_reason {
    NOACK_HOUSEKEEPING, /* the time for housekeeping has come */
    NOACK_NEW_CLIENT,   /* the current datagram is from a new client */
    NOACK_RECORD_FULL,  /* a buffer of the record's rows is full and must be emptied */
    NOACK_CHANGE_DUE,   /* other settings apply from the current datagram on */
    NOACK_INTERRUPTED,  /* by a signal: Python handles it */
    NOACK_LEAVING_FULL, /* the list of departures is full and must be sent */
    NOACK_CARRY_ON
};

/* The socket that sends a direction's datagrams, and their destination. */
enum noack_sends {
    NOACK_OWN_SOCKET,       /* the client's socket, which is connected to the destination */
    NOACK_DESTINATION_NAME, /* the link's sending socket, not connected, to the destination */
    NOACK_CLIENT_NAME,      /* the link's listening socket, to the client */
    NOACK_LINK_SOCKET,      /* the link's sending socket, which is connected to the destination */
    NOACK_LISTENING_SOCKET  /* the link's listening socket, which is a device */
};

/* A socket of the relay. It has 16 bytes: those of thousands of clients fill the caches. */
typedef struct {
    int32_t fd, error; /* if fd is -1, error is the errno of the failure to open it */
    int32_t is_queued; /* 1: head and tail are the first and the last of its datagrams to be sent */
    uint16_t head, tail;
} noack_socket;

/* A client of the relay. What a datagram needs is in the first 64 bytes, a cache line. */
typedef struct {
    int64_t key[5];
    int64_t last_ns;                 /* last datagram of the client or of the destination */
    int32_t in_flight;
    int32_t link;
    int32_t flow_row;                /* of its flows in the states of the link's two directions */
    int32_t name_bytes;
    int64_t number;                  /* number of its flows; -1: the row is free */
    uint8_t name[NOACK_NAME_BYTES];
} noack_client;

/* One direction of a link in the relay. */
typedef struct {
    noack_link *link;
    int64_t keeps;                    /* 1: datagrams can be delayed or changed */
    int64_t sends;
    int64_t name_bytes;
    uint8_t name[NOACK_NAME_BYTES];   /* forward: the server's */
    int64_t full;                     /* 1: further clients that begin in it are refused */
    int64_t refused;
    int64_t port_unreachable;         /* forward: ICMP port-unreachable errors */
    int64_t delays[NOACK_BUCKETS];    /* histogram of the time from arrival to departure */
    /* of the time from a delayed datagram's release time to its departure */
    int64_t lateness[NOACK_BUCKETS];
    int64_t errors[NOACK_ERRNOS];     /* datagrams that could not be sent or stored, by errno */
} noack_direction;

/* The relay. Times are simulated and count from its start, unless stated otherwise. */
typedef struct {
    int64_t links;
    /* 1: there is one link, between two TUN devices: the inner one is its listening socket, the
       outer one its sending socket; a client is a flow: a 5-tuple */
    int64_t devices;
    int64_t epoll;
    /* the one that it waits for, by receiving; -1: epoll waits for sockets */
    int64_t only_socket;
    int64_t receive_wait_ns;     /* how long it waits (SO_RCVTIMEO) */
    noack_clock clock;           /* its epoch is the relay's start */
    /* arrival of the current datagram, or its release time; never decreases */
    int64_t now_ns;
    int64_t read_ns;             /* the last reading of the clock; never decreases */
    int64_t change_ns;           /* time from which other settings apply */
    int64_t spin_ns;             /* time before a departure in which it does not sleep */
    int64_t segment;             /* 1: send datagrams of equal size as one message */
    int64_t segment_below;       /* the kernel does not segment datagrams of this size */
    int64_t records;             /* 1: write rows of the record */
    /* of a run: its loops, whose numbers are in the headers; their clients' rows begin at 0; 0: not
       of a run */
    int64_t loops;
    int64_t no_loop;             /* datagrams refused because of this number */
    int64_t inputs;              /* number of the next row of the record */
    int64_t no_memory;           /* 1: no memory for more delayed datagrams */

    int64_t headroom_bytes;      /* of memory, that delayed datagrams leave free */

    /* Tables; after the sockets of the links (listening, then sending), those of the clients. */
    int64_t client_rows, table_places, slot_count, block_count, row_count;
    noack_socket *sockets;       /* (2 links + client_rows,) */
    noack_client *clients;
    uint64_t secret[2];          /* of the hash: a random key of this process */
    /* (table_places, a power of 2) rows of clients by the hash of their key */
    int32_t *table;
    noack_direction *directions; /* (2 links,) forward and reverse direction of each link */
    noack_heap_entry *heap;      /* (slot_count,) */
    struct noack_slot *slots;
    noack_waiting *waiting;      /* (slot_count,) */
    uint8_t **chunks;            /* chunks of blocks */
    int32_t *block_next;         /* (block_count,) */
    noack_packet_row *packets;
    noack_release_row *releases;
    int64_t heap_length, packet_rows, release_rows;
    int64_t delayed_count;       /* datagrams that have been delayed so far */
    int64_t free_slot, free_slots, free_block, free_blocks;
    struct relay_scratch *scratch;
    void *client_memory, *scratch_memory;
} noack_relay;

/* Return a relay that has room for some clients, keeps row_count rows of each table of the record (0:
   there is no record), and waits with a descriptor of epoll. secret: see above. NULL: there is no
   memory. */
noack_relay *noack_relay_new(
    int64_t links, int64_t clients, int64_t row_count, int64_t epoll, const uint64_t secret[2],
    const char **wrong);
void noack_relay_free(noack_relay *relay);

/* Double the room for clients; return 0 if there is no memory. */
int64_t noack_relay_add_clients(noack_relay *relay);

/* Receive the kernel's timestamps of arrivals, too: delays count from the arrival. */
void noack_relay_read_stamps(noack_relay *relay);

/* Wait for a socket's datagrams, too; return 0 or errno. socket is its place in sockets. */
int64_t noack_relay_watch(noack_relay *relay, int64_t fd, int64_t socket);

/* Relay until Python is needed, or until a time; return a noack_reason. INT64_MIN: do what is due,
   and do not wait. */
int64_t noack_relay_run(noack_relay *relay, int64_t until_ns);

/* Add a datagram as if a socket had just received it; noack_relay_run decides for it. */
void noack_relay_add_datagram(
    noack_relay *relay, int64_t socket, const uint8_t name[NOACK_NAME_BYTES], const uint8_t *data,
    int64_t size_bytes);

/* The sender of the current datagram, and the place of the socket that received it. */
const uint8_t *noack_relay_sender(const noack_relay *relay);
int64_t noack_relay_receiver(const noack_relay *relay);

/* Last departure time of each flow's packets in flight, (rows,); the caller fills it with -1. */
void noack_relay_latest(noack_relay *relay, int64_t direction, int64_t *latest_ns);

/* The table of clients: find the row of a name (-1: none), insert a row, remove it. */
int64_t noack_client_find(
    const noack_relay *relay, const uint8_t name[NOACK_NAME_BYTES], int64_t link);
void noack_client_insert(noack_relay *relay, int64_t row);

/* The hash of a client's key with a secret of this process. */
uint64_t noack_client_hash(const uint64_t secret[2], const int64_t key[5]);
void noack_client_remove(noack_relay *relay, int64_t row);

/* The bucket of a time in a histogram: 32 for each doubling. */
int64_t noack_bucket_of(int64_t t_ns);
