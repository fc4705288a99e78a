/* The core's one declaration of every structure and function that Python uses.

   native/build.py gives this file to cffi, and noack/core/core_library.py makes numpy's row types
   of it. Therefore it has declarations, enumerations and these comments only; every number is an
   int64_t or a double. Times are integer nanoseconds. Python allocates all memory; the core keeps
   no state of its own, and calls neither clock nor allocator. */

/* ---- Packets ------------------------------------------------------------------------------- */

enum {
    NOACK_NEVER_NS = -1,           /* a time that never comes */
    NOACK_OPPORTUNITY_BYTES = 1504 /* that a delivery opportunity of mahimahi carries */
};

enum noack_fate { /* noack.protocol.record_tables.Fate */
    NOACK_DELIVERED,
    NOACK_DROPPED,
    NOACK_FORCED,
    NOACK_CORRUPTED,
    NOACK_OVERFLOWED,
    NOACK_BLACKED_OUT
};

typedef struct { /* the decision for a packet; the stages modify it one after the other */
    int64_t fate;
    int64_t packet;             /* its number in its flow */
    int64_t consecutive_losses; /* consecutive losses up to this packet */
    int64_t release_ns;         /* departure time; NOACK_NEVER_NS: never */
    int64_t copy_ns;            /* departure time of its copy; NOACK_NEVER_NS: never */
    int64_t bit;                /* the bit that is flipped; -1: none */
    int64_t copy_bit;           /* the bit that is flipped in the copy; -1: none */
    int64_t hold_back_ns;       /* time for which it is held back for the guarantee */
    int64_t makes_stale;        /* number of packets that it makes stale */
    int64_t arrival_ns;
    int64_t size_bytes; /* of the payload */
    int64_t must_pass;  /* 1: the guarantee requires its delivery */
    int64_t spared;     /* 1: it must pass, and a stage would have lost it */
} noack_decision;

typedef struct { /* a recorded decision, which a flow repeats */
    int64_t fate;
    int64_t delay_ns; /* time from arrival to departure; -1: it never left */
    int64_t copy_delay_ns;
    int64_t bit;
    int64_t copy_bit;
} noack_recorded;

/* ---- Stages: the settings of an impairment as numbers ---------------------------------------- */

enum noack_stage_kind { /* native/impairments has a file for each */
    NOACK_BERNOULLI,
    NOACK_FOUR_STATE,
    NOACK_GILBERT_ELLIOTT,
    NOACK_PERIODIC,
    NOACK_SCRIPTED,
    NOACK_WORST_CASE,
    NOACK_CODEL,
    NOACK_TAIL_DROP,
    NOACK_BLACKOUT,
    NOACK_CORRUPT,
    NOACK_DELAY,
    NOACK_DUPLICATE,
    NOACK_OPPORTUNITIES,
    NOACK_REORDER,
    NOACK_REPLAY,
    NOACK_STAGE_KINDS
};

typedef struct { /* an event with a probability, correlated between successive packets */
    double probability;
    double threshold; /* z with 1 - Phi(z) = probability; infinite if that is 0 or 1 */
    double correlation;
    double innovation; /* sqrt(1 - correlation^2) */
    int64_t gap;       /* only every gap-th packet can be affected */
    int64_t scored;    /* 1: a later delay is correlated with this event */
} noack_chance;

typedef struct {
    double p13, p31, p32, p23, p14;
} noack_four_state;

typedef struct {
    double good_to_bad, bad_to_good;
    double loss_in_good, loss_in_bad;
    double share_bad; /* share of packets in the bad state: p/(p + r) */
    int64_t scored;   /* 1: a later delay is correlated with the state */
    int64_t step_ns;  /* time between changes of the link's state; 0: each flow has its own */
} noack_gilbert_elliott;

typedef struct {
    int64_t period, burst, first;
} noack_periodic;

typedef struct { /* a script: a range of the table of integers, which ascend there */
    int64_t period; /* 0: the script does not repeat */
    int64_t begin, end;
} noack_scripted;

typedef struct { /* a rate limit; the stage's queue_places is the size of the queue */
    int64_t rate_bps;
    int64_t overhead_bytes;
    int64_t cell_bytes;
    int64_t cell_overhead_bytes;
    int64_t target_ns; /* CoDel */
    int64_t interval_ns;
    int64_t mtu_ns; /* transmission time of one MTU */
} noack_bottleneck;

typedef struct { /* a range of the table of integers: all begins, then all ends, ascending */
    int64_t begin, end;
    int64_t period_ns; /* 0: the intervals do not repeat */
} noack_blackout;

enum noack_delay_shape {
    NOACK_UNIFORM,
    NOACK_NORMAL,
    NOACK_PARETO,
    NOACK_PARETONORMAL,
    NOACK_EMPIRICAL
};

typedef struct {
    double constant_ns, jitter_ns;
    int64_t shape;
    int64_t begin, end; /* empirical quantiles in ns, a range of the table of reals */
    double correlation, innovation;
    double loss_correlation, loss_innovation;
} noack_delay;

typedef struct { /* times in ms, a range of the table of integers; they repeat after the last */
    int64_t begin, end;
    int64_t offset_ns; /* time in the schedule at time 0 */
    int64_t overhead_bytes;
    int64_t queue_bytes; /* 0: no limit in bytes */
} noack_opportunities;

typedef struct {
    int64_t begin, end;  /* delays in ns, a range of the table of integers; -1 - d for a lost packet
                            that takes d if it must pass */
    int64_t times_begin; /* sending times in ns, which do not descend */
    int64_t offset;      /* first record; by time, the first time in ns */
    int64_t period_ns;   /* length of the trace; 0: by packet */
    int64_t once;
} noack_replay;

typedef struct {
    int64_t kind;
    int64_t key0, key1;   /* key of its random stream: two words of 32 bits */
    int64_t queue_places; /* places of its ring in departures_ns; 0: no queue */
    int64_t queue_begin;  /* first of these places */
    union {
        noack_chance chance;
        noack_four_state four_state;
        noack_gilbert_elliott gilbert_elliott;
        noack_periodic periodic;
        noack_scripted scripted;
        noack_bottleneck bottleneck;
        noack_blackout blackout;
        noack_delay delay;
        noack_opportunities opportunities;
        noack_replay replay;
    };
} noack_stage;

/* ---- State ----------------------------------------------------------------------------------- */

typedef struct { /* a stage's memory of a flow */
    int64_t phase;
    double score;
} noack_stage_memory;

typedef struct { /* a link's state of a flow */
    int64_t number;             /* never used again on this link; selects its random numbers */
    int64_t forced_first;       /* 1: the first packet is still to come, and must be delivered */
    int64_t packets;            /* packets that have arrived */
    int64_t consecutive_losses; /* up to the last packet */
    int64_t first_release_ns;   /* departure time of the first packet, if it had to be delivered */
    double score;               /* normal score of the link's state for the last packet */
    int64_t newest;             /* greatest number among the packets that have left intact */
    int64_t since;              /* number of the first packet under the present settings */
    int64_t longest_loss_burst; /* since then; counts final losses only */
} noack_flow;

typedef struct { /* a stage's state that all flows share; departure times lie in a ring */
    int64_t head, count;
    int64_t entry_ns;
    int64_t busy_until_ns; /* opportunities: time of the last opportunity that was used */
    int64_t carry;         /* fraction of a nanosecond, in units of 1/rate_bps */
    int64_t first_above_ns, drop_next_ns; /* CoDel: the variables of RFC 8289, Section 5 */
    int64_t drops;                        /* count_ of the RFC */
    int64_t last_drops, dropping;
    int64_t dropped_before;    /* 1: the law dropped the previous packet; drop_next_ns is not new */
    int64_t used, left_bytes;  /* opportunities: which of those at busy_until_ns, from 1; its rest */
    int64_t total_bytes;       /* all bytes that were put into the queue */
    int64_t phase, step;       /* Gilbert-Elliott, common to all flows: state, and number of its step */
} noack_queue;

typedef struct {
    int64_t received, received_bytes;
    int64_t delivered, dropped, forced, corrupted, overflowed, blacked_out;
    int64_t duplicated;
    int64_t held_back;                  /* for the guarantee */
    int64_t forwarded, forwarded_bytes; /* packets and copies that have left */
    int64_t delivered_out_of_order;     /* left after a later one of their flow: stale */
    int64_t longest_loss_burst;         /* of a flow, under the present settings */
    int64_t most_in_flight;
} noack_counters;

typedef struct { /* at most so many losses among any so many consecutive packets of a flow */
    int64_t losses, packets;
} noack_window;

typedef struct { /* one direction of a link */
    /* settings */
    int64_t stage_count, integer_count, real_count, window_count, decision_count;
    noack_stage *stages; /* in order of application */
    int64_t *integers;   /* tables of the stages */
    double *reals;
    noack_window *windows; /* further maxima of losses */
    noack_recorded *decisions; /* recorded decisions, flow by flow */
    int64_t *decisions_begin;  /* (recorded_flows + 1,) */
    int64_t recorded_flows;
    int64_t recovery; /* minimum of consecutive deliveries between two loss bursts; 0: none */
    int64_t mansd;    /* maximum of consecutive losses, M - 1; -1: none */
    int64_t limit;    /* maximum number of packets delayed at once */
    int64_t tracks;   /* 1: packets can be delivered out of order */
    /* state */
    int64_t rows;               /* flows that have room */
    int64_t recent_width;       /* a power of 2, of mansd + 1 at least if it tracks */
    int64_t loss_width;         /* a power of 2 */
    int64_t departure_places;
    noack_flow *flows;          /* (rows,) */
    noack_stage_memory *memory; /* (rows, stage_count) */
    int64_t *recent_ns;         /* (rows, recent_width) release times of the last packets */
    int64_t *losses;            /* (rows, loss_width) numbers of losses so far, S */
    noack_queue *queues;        /* (stage_count,) */
    int64_t *departures_ns;     /* (departure_places,) the rings of the queues */
    int64_t in_flight;          /* delayed packets and copies */
    noack_counters counters;
} noack_link;

/* ---- A link ---------------------------------------------------------------------------------- */

/* Return NULL, or what is wrong with the numbers of a link: all that the other functions assume. */
const char *noack_link_check(const noack_link *link);

/* The same for its recorded decisions, of which there may be millions. */
const char *noack_recorded_check(const noack_link *link);

/* Begin a flow in a row. restarted: packets of the flow may have been lost before. */
void noack_link_start_flow(
    noack_link *link, int64_t row, int64_t number, int64_t first_delivered, int64_t restarted);

/* Decide for a packet that arrives at now_ns; row is that of its flow. */
void noack_link_decide(
    noack_link *link, int64_t row, int64_t size_bytes, int64_t now_ns, noack_decision *decision);

/* Decide for count packets, in order of arrival. */
void noack_link_decide_many(
    noack_link *link, int64_t count, const int64_t *rows, const int64_t *sizes_bytes,
    const int64_t *arrivals_ns, noack_decision *decisions);

/* Note that a packet or a copy leaves; return 1 if it is stale. delayed: it was in flight. counts:
   it is the packet's first intact copy. */
int64_t noack_link_leave(
    noack_link *link, int64_t row, int64_t packet, int64_t size_bytes, int64_t delayed,
    int64_t counts);

/* Load the state of a flow into the processor's caches; return a number that depends on it. */
int64_t noack_link_touch(const noack_link *link, int64_t row);

/* Transfer the state of a link to one with other settings, which has as many rows and shares the
   array of flows. latest_ns: (rows,) last departure time of the packets in flight; -1: none. */
void noack_link_change(const noack_link *before, noack_link *after, const int64_t *latest_ns);

/* Begin the flow of row 0 again, with other keys, (stage_count, 2): another run of a batch. */
void noack_link_renew(noack_link *link, const int64_t *keys, int64_t first_delivered);

/* ---- Parts of a decision, for predictions and tests ------------------------------------------ */

int64_t noack_must_pass(const noack_link *link, int64_t row);
int64_t noack_hold_back_until(
    const noack_link *link, int64_t row, int64_t packet, int64_t desired_ns);
void noack_settle(noack_link *link, int64_t row, noack_decision *decision);
int64_t noack_queue_enters(noack_link *link, int64_t stage, int64_t now_ns);
int64_t noack_queue_serve(noack_link *link, int64_t stage, int64_t size_bytes);
double noack_delay_quantile_ns(const noack_delay *delay, const double *reals, double u);
double noack_normal_cdf(double z);
double noack_normal_score(double u);
void noack_philox(const int64_t counter[4], const int64_t key[2], int64_t words[4]);
void noack_uniforms(
    int64_t key0, int64_t key1, int64_t flow, int64_t packet, int64_t block, double uniform[2]);

/* ---- The relay: waits for, receives, decides, sends ------------------------------------------ */

enum {
    NOACK_NAME_BYTES = 32,    /* room for a socket address; those of IPv6 have 28 bytes */
    NOACK_HEAD_BYTES = 32,    /* of a payload, that a record has */
    NOACK_ERRNOS = 256,
    NOACK_BLOCK_BYTES = 512,  /* payloads of delayed datagrams are kept in chained blocks */
    NOACK_CHUNK_BLOCKS = 4096, /* number of blocks per allocation */
    NOACK_BUCKETS = 1280      /* of a histogram of times */
};

enum noack_reason { /* why the relay returned; the last two occur within it only */
    NOACK_HOUSEKEEPING, /* the time for housekeeping has come */
    NOACK_NEW_CLIENT,   /* the current datagram is from a new client */
    NOACK_STORE_FULL,   /* there is no room to store the current datagram */
    NOACK_EVENTS_FULL,  /* a buffer of events or of record rows is full and must be emptied */
    NOACK_CHANGE_DUE,   /* other settings apply from the current datagram on */
    NOACK_LEAVING_FULL, /* the list of departures is full and must be sent */
    NOACK_CARRY_ON
};

enum noack_sends { /* the socket that sends a direction's datagrams, and their destination */
    NOACK_OWN_SOCKET,       /* the client's socket, which is connected to the destination */
    NOACK_DESTINATION_NAME, /* the link's sending socket, not connected, to the destination */
    NOACK_CLIENT_NAME,      /* the link's listening socket, to the client */
    NOACK_LINK_SOCKET       /* the link's sending socket, which is connected to the destination */
};

typedef struct {
    int32_t fd, error; /* if fd is -1, error is the errno of the failure to open it */
    int32_t head, tail;
    int64_t stamp;
} noack_socket;

typedef struct {
    int64_t key[4];
    int64_t last_ns; /* last datagram of the client or of the destination */
    int64_t number;  /* number of its flows; -1: the row is free */
    int32_t in_flight;
    int32_t link;
    int32_t place; /* row of its flows in the link's two states */
    int32_t name_bytes;
    uint8_t name[32];
    uint8_t local[32]; /* address of its return path */
} noack_client;

typedef struct { /* one direction of a link in the relay */
    noack_link *link;
    int64_t keeps; /* 1: datagrams can be delayed or changed */
    int64_t sends;
    int64_t name_bytes;
    uint8_t name[32];   /* forward: the server's */
    uint8_t listen[32]; /* the link's address */
    int64_t full;       /* forward: 1: further clients are refused */
    int64_t refused;
    int64_t port_unreachable; /* forward: ICMP port-unreachable errors */
    int64_t delays[1280];     /* histogram of the time from arrival to departure */
    int64_t lateness[1280];   /* of the time from a delayed datagram's release time to its departure */
    int64_t errors[256];      /* datagrams that could not be sent or stored, by errno */
} noack_direction;

typedef struct { /* a stored datagram */
    int64_t packet, arrival_ns, bit;
    int32_t size_bytes;
    int32_t block; /* first block of the payload */
    int32_t direction, client;
    int32_t next; /* next free slot */
    uint8_t copy, counts, fate, unused;
} noack_slot;

typedef struct { /* an entry of the heap of delayed datagrams */
    int64_t release_ns, number, slot;
} noack_heap_entry;

typedef struct {    /* a datagram that arrives or departs; a tap receives it */
    int64_t t_ns;   /* Unix time */
    int64_t flow;   /* number of the flow within the link */
    int64_t packet; /* number of the datagram within its flow */
    int64_t consecutive_losses; /* arrival: up to and including this datagram */
    int64_t mansd;              /* the maximum of consecutive losses (M - 1); -1: none */
    int64_t delay_ns;      /* arrival: decided delay, -1: never leaves; departure: actual delay */
    int64_t copy_delay_ns; /* arrival: decided delay of its copy; -1: no copy */
    int64_t hold_back_ns;  /* arrival: time held back for the guarantee */
    int64_t bit;           /* the corrupted bit of the payload; -1: none */
    int64_t copy_bit;      /* arrival: the corrupted bit of its copy; -1: none */
    uint64_t offset;       /* place of the payload in the batch's data, if a tap needs data */
    uint32_t size_bytes;   /* of the payload */
    uint32_t link;         /* number of the link */
    uint32_t interface; /* 2 link is the link's client side, 2 link + 1 the server side */
    uint16_t source_port, destination_port;
    uint8_t source[16]; /* an IPv4 address is in the first 4 bytes */
    uint8_t destination[16];
    uint8_t family;    /* 4 or 6: the version of IP */
    uint8_t departure; /* 0: a datagram arrived here; 1: it or its copy departed here */
    uint8_t direction; /* 0: forward, from client to server; 1: reverse */
    uint8_t fate;
    uint8_t copy;  /* departure: 1 is the duplicate */
    uint8_t stale; /* departure: a newer datagram of the flow had left before */
    uint8_t unused[2];
} noack_event;

typedef struct { /* a row of the record's table netem_packet */
    int64_t input, sequence, t_ns, now_ns, flow, fate, consecutive_losses;
    int64_t release_ns, copy_ns, bit, size_bytes;
    uint8_t head[32];
} noack_packet_row;

typedef struct { /* a row of the record's table netem_release */
    int64_t input, sequence, t_ns, now_ns, flow, copy, stale;
} noack_release_row;

typedef struct { /* times are simulated and count from the relay's start, unless stated otherwise */
    int64_t links;
    int64_t epoll;
    int64_t epoch_ns; /* the monotonic clock at the relay's start */
    int64_t unix_ns;  /* Unix time at the relay's start */
    double speed;     /* simulated time per time of the monotonic clock */
    int64_t now_ns;   /* arrival of the current datagram, or its release time; never decreases */
    int64_t read_ns;  /* the last reading of the clock; never decreases */
    int64_t change_ns; /* time from which other settings apply */
    int64_t spin_ns;   /* time before a departure in which it does not sleep */
    int64_t segment;   /* 1: send datagrams of equal size as one message */
    int64_t segment_below; /* the kernel does not segment datagrams of this size */
    int64_t taps;          /* 0: none; 1: without data; 2: with data */
    int64_t records;       /* 1: write rows of the record */
    int64_t loops;         /* of a run: its loops; the rows of their clients begin at 0 */
    int64_t by_loop;       /* 1: a datagram has its loop's number in its header */
    int64_t no_loop;       /* datagrams refused because of this number */
    int64_t inputs;        /* number of the next row of the record */
    int64_t first_number;  /* number of the first packet in the record */
    int64_t no_memory;     /* 1: no memory for more delayed datagrams */
    /* Tables; after the sockets of the links (listening, then sending), those of the clients. */
    int64_t client_rows, table_places, slot_count, block_count, event_count, data_bytes, row_count;
    noack_socket *sockets; /* (2 links + client_rows,) */
    noack_client *clients;
    int32_t *table; /* (table_places, a power of 2) rows of clients by the hash of their key */
    noack_direction *directions; /* (2 links,) forward and reverse direction of each link */
    noack_heap_entry *heap;      /* (slot_count,) */
    noack_slot *slots;
    uint8_t **chunks;    /* chunks of blocks */
    int32_t *block_next; /* (block_count,) */
    noack_event *events;
    uint8_t *data; /* payloads of the events */
    noack_packet_row *packets;
    noack_release_row *releases;
    int64_t heap_length, event_length, data_length, packet_rows, release_rows;
    int64_t put; /* datagrams that have been delayed so far */
    int64_t free_slot, free_slots, free_block, free_blocks;
    void *scratch; /* noack_relay_scratch_bytes() bytes, which are 0 at first */
} noack_relay;

int64_t noack_relay_scratch_bytes(void);

/* Prepare the scratch. */
void noack_relay_open(noack_relay *relay);

/* Receive the kernel's timestamps of arrivals, too: delays count from the arrival. */
void noack_relay_read_stamps(noack_relay *relay);

/* Wait for a socket's datagrams, too; return 0 or errno. number is its place in sockets. */
int64_t noack_relay_watch(noack_relay *relay, int64_t fd, int64_t number);

/* Relay until Python is needed, or until a time; return a noack_reason. */
int64_t noack_relay_run(noack_relay *relay, int64_t until_ns);

/* Add a datagram as if a socket had just received it; noack_relay_run decides for it. */
void noack_relay_add_datagram(
    noack_relay *relay, int64_t socket, const uint8_t name[32], const uint8_t *data,
    int64_t size_bytes);

/* The sender of the current datagram, and the place of the socket that received it. */
const uint8_t *noack_relay_sender(const noack_relay *relay);
int64_t noack_relay_receiver(const noack_relay *relay);

/* Last departure time of each flow's packets in flight, (rows,); the caller fills it with -1. */
void noack_relay_latest(const noack_relay *relay, int64_t direction, int64_t *latest_ns);

/* The table of clients: find the row of a name (-1: none), insert a row, remove it. */
int64_t noack_client_find(const noack_relay *relay, const uint8_t name[32], int64_t link);
void noack_client_insert(noack_relay *relay, int64_t row);
void noack_client_remove(noack_relay *relay, int64_t row);

/* The bucket of a time in a histogram: 32 for each doubling. */
int64_t noack_bucket_of(int64_t t_ns);

/* A capture (pcapng). An interface is a side of a link. */

enum { NOACK_CAPTURE_BYTES = 600 }; /* of a block, beside its payload, at most */

/* Return NULL, or what is wrong with the events of a batch: all that noack_capture_blocks assumes.
   data_bytes: size of the batch's payloads. */
const char *noack_capture_check(
    const noack_event *events, int64_t count, int64_t data_bytes, int64_t interfaces);

/* Write the events' blocks into out, which has room for count NOACK_CAPTURE_BYTES and the payloads;
   return their bytes. missing: (interfaces,) events that are missing before these, which the next
   block states, and which are 0 then; written: (interfaces,) counts the blocks. */
int64_t noack_capture_blocks(
    const noack_event *events, int64_t count, const uint8_t *data, int64_t *missing,
    int64_t *written, uint8_t *out);
