/* The network: what a link does with packets. */

/* ---- The header of a run's datagram (docs/wire.md) -------------------------------------------- */

enum { NOACK_HEADER_BYTES = 32 };

/* What its message is, as noack.protocol.wire_format.Flow. */
enum noack_message_kind {
    NOACK_MEASUREMENT = 1,
    NOACK_UPDATE,
    NOACK_ACTUATION,
    NOACK_ACKNOWLEDGEMENT
};

/* ---- Packets --------------------------------------------------------------------------------- */

enum {
    NOACK_NEVER_NS = -1,           /* a time that never comes */
    NOACK_HEAD_BYTES = 32,         /* of a payload, that a record has */
    NOACK_OPPORTUNITY_BYTES = 1504 /* that a delivery opportunity of mahimahi carries */
};

/* What becomes of a packet, as netem.core.packet_rows.Fate. */
enum noack_fate {
    NOACK_DELIVERED,
    NOACK_DROPPED,
    NOACK_FORCED,
    NOACK_CORRUPTED,
    NOACK_OVERFLOWED,
    NOACK_BLACKED_OUT
};

/* The decision for a packet. */
typedef struct {
    int64_t fate;
    int64_t packet;             /* its number in its flow */
    int64_t consecutive_losses; /* consecutive losses up to this packet */
    int64_t release_ns;         /* departure time; NOACK_NEVER_NS: never */
    int64_t copy_ns;            /* departure time of a second copy; NOACK_NEVER_NS: never */
    int64_t bit;                /* the bit that is flipped; -1: none */
    int64_t copy_bit;           /* the bit that is flipped in the second copy; -1: none */
    int64_t hold_back_ns;       /* time for which it is held back for the guarantee */
    int64_t makes_stale;        /* number of packets that it makes stale */
    int64_t arrival_ns;
    int64_t size_bytes;         /* of the payload */
    int64_t must_pass;          /* 1: the guarantee requires its delivery */
    int64_t loss_suppressed;    /* 1: it must pass, and a stage would have lost it */
    /* 1: it waits in the scheduler's queue, so that its departure is not known: release_ns is the
       earliest time */
    int64_t waits;
    int64_t key;                /* of a waiting packet: the smallest key leaves first */
    /* of a waiting packet: time from the end of its transmission to its departure; before the last
       stage: minus the earliest begin of its transmission */
    int64_t after_ns;
} noack_decision;

/* ---- Stages: the settings of an impairment as numbers ---------------------------------------- */

/* The kinds of impairments; native/impairments/ has a file for each. */
enum noack_stage_kind {
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
    NOACK_EARLIEST_DEADLINE,
    NOACK_MAXIMUM_ERROR,
    NOACK_OPPORTUNITIES,
    NOACK_PRIORITY,
    NOACK_REORDER,
    NOACK_REPLAY,
    NOACK_SCHEDULE,
    NOACK_STAGE_KINDS
};

/* An event with a probability, correlated between successive packets. */
typedef struct {
    double probability;
    double threshold;  /* z with 1 - Phi(z) = probability; infinite if that is 0 or 1 */
    double correlation;
    double innovation; /* sqrt(1 - correlation^2) */
    int64_t gap;       /* only every gap-th packet can be affected */
    int64_t scored;    /* 1: a later delay is correlated with this event */
} noack_chance;

/* The four-state model of losses: probabilities of its transitions. */
typedef struct {
    double p13, p31, p32, p23, p14;
} noack_four_state;

/* The Gilbert-Elliott model: a good and a bad state of the link. */
typedef struct {
    double good_to_bad, bad_to_good;
    double loss_in_good, loss_in_bad;
    double share_bad; /* share of packets in the bad state: p/(p + r) */
    int64_t scored;   /* 1: a later delay is correlated with the state */
    int64_t step_ns;  /* time between changes of the link's state; 0: each flow has its own */
} noack_gilbert_elliott;

/* Of each period packets, counted from the packet of number first, the first burst are lost. */
typedef struct {
    int64_t period, burst, first;
} noack_periodic;

/* A script of losses: a range of the table of integers, which ascend there. */
typedef struct {
    int64_t period; /* 0: the script does not repeat */
    int64_t begin, end;
} noack_scripted;

/* A rate limit; the stage's queue_places is the size of the queue in packets. */
typedef struct {
    int64_t rate_bps;
    int64_t overhead_bytes;
    int64_t cell_bytes;
    int64_t cell_overhead_bytes;
    int64_t queue_bytes; /* size of the queue in bytes; 0: no limit in bytes */
    int64_t burst_bytes; /* that a token bucket holds; 0: no bucket */
    /* time that the rate needs for the burst: burst_ns - burst_carry/rate_bps ns */
    int64_t burst_ns, burst_carry;
    int64_t target_ns, interval_ns; /* of CoDel */
    int64_t mtu_ns;                 /* transmission time of one MTU */
    /* priority, earliest deadline: the number of each flow, a range of the table of integers; the
       last is that of all further flows, too */
    int64_t begin, flows;
} noack_bottleneck;

/* Intervals without delivery, a range of the table of integers: all begins, then all ends,
   ascending. */
typedef struct {
    int64_t begin, end;
    int64_t period_ns; /* 0: the intervals do not repeat */
} noack_blackout;

/* The distribution of the random delay. */
enum noack_delay_shape {
    NOACK_UNIFORM,
    NOACK_NORMAL,
    NOACK_PARETO,
    NOACK_PARETONORMAL,
    NOACK_EMPIRICAL
};

/* A constant delay and a random one. */
typedef struct {
    double constant_ns, jitter_ns;
    int64_t shape;
    int64_t begin, end; /* empirical quantiles in ns, a range of the table of reals */
    double correlation, innovation;
    double loss_correlation, loss_innovation;
    int64_t ordered; /* 1: no packet passes before an earlier one of its flow */
} noack_delay;

/* A trace of delivery opportunities: times in ms, a range of the table of integers; they repeat
   after the last. */
typedef struct {
    int64_t begin, end;
    int64_t offset_ns;   /* time in the schedule at time 0 */
    int64_t overhead_bytes;
    int64_t queue_bytes; /* 0: no limit in bytes */
} noack_opportunities;

/* A packet trace that is replayed. */
typedef struct {
    /* delays in ns, a range of the table of integers; -1 - d for a lost packet that takes d if it
       must pass */
    int64_t begin, end;
    int64_t times_begin; /* sending times in ns, which do not descend */
    int64_t offset;      /* first record; by time, the first time in ns */
    int64_t period_ns;   /* length of the trace; 0: by packet */
    int64_t once;        /* 1: it does not repeat */
} noack_replay;

/* Slots for flows. The table of integers has from begin on: flows + 1 places, then the numbers of
   the slots in a round, of flow k from the k-th to the next place. */
typedef struct {
    int64_t begin, flows;
    int64_t slots, slot_ns; /* in a round, and the length of one */
    int64_t queue;          /* most own slots that may be taken after a packet's arrival */
} noack_schedule;

/* A stage of a link: the settings of an impairment. */
typedef struct {
    int64_t kind;
    int64_t key0, key1;   /* key of its random stream: two words of 32 bits */
    int64_t queue_places; /* packets that its queue can have; 0: no queue */
    int64_t queue_begin;  /* where its ring begins in departures_ns */
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
        noack_schedule schedule;
    };
} noack_stage;

/* ---- State ----------------------------------------------------------------------------------- */

/* A link's state of a flow. */
typedef struct {
    int64_t number;             /* never used again on this link; selects its random numbers */
    int64_t forced_first;       /* 1: the first packet is still to come, and must be delivered */
    int64_t packets;            /* packets that have arrived */
    int64_t consecutive_losses; /* up to the last packet */
    /* no packet leaves before: departure time of the first one, if it had to be delivered; with a
       scheduler, of the last one; of the last one in flight at a change */
    int64_t first_release_ns;
    int64_t newest;             /* greatest number among the packets that have left intact */
    int64_t since;              /* number of the first packet under the present settings */
    int64_t error_level;        /* of the packet that arrives; 0: unknown. The caller sets it */
    int64_t waiting_count;      /* packets that wait until the link is free */
    int64_t last_waiting;       /* place of the last one */
    int64_t longest_loss_burst; /* since then; counts final losses only */
} noack_flow;

/* What has happened to the packets of one direction of a link. */
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

/* At most `losses` losses among any `packets` consecutive packets of a flow. */
typedef struct {
    int64_t losses, packets;
} noack_window;

/* One direction of a link, and the memory of packets that wait until it is free: network.h. */
typedef struct noack_waiting noack_waiting;
typedef struct noack_link noack_link;

/* Its settings. */
typedef struct {
    int64_t stage_count, integer_count, real_count, window_count;
    const noack_stage *stages;     /* in order of application; queue_begin is not read */
    const int64_t *integers;       /* tables of the stages */
    const double *reals;
    const noack_window *windows;   /* further maxima of losses */
    /* minimum of consecutive deliveries between two loss bursts; 0: none */
    int64_t recovery;
    int64_t mansd;                 /* maximum of consecutive losses, M - 1; -1: none */
    int64_t limit;                 /* maximum number of packets delayed at once */
    int64_t can_reorder;                /* 1: packets can be delivered out of order */
    int64_t rows;                  /* flows for which there is room at first */
} noack_link_settings;

/* ---- A link ---------------------------------------------------------------------------------- */

/* Return a link with copies of the settings. NULL: wrong says what is wrong with them, or, if it is
   NULL, too, there is no memory; so do all functions with this argument. */
noack_link *noack_link_new(const noack_link_settings *settings, const char **wrong);
void noack_link_free(noack_link *link);

/* Begin a flow in a row, for which room is made; return 0 if there is no memory. */
int64_t noack_link_start_flow(
    noack_link *link, int64_t row, int64_t number, int64_t first_delivered);

/* Its flows, (rows,), until a flow begins; its stages and their table of reals; its counts; its number
   of rows; whether packets can be delivered out of order; the number of delayed packets and copies. */
noack_flow *noack_link_flows(const noack_link *link);
const noack_stage *noack_link_stages(const noack_link *link);
const double *noack_link_reals(const noack_link *link);
const noack_counters *noack_link_counters(const noack_link *link);
int64_t noack_link_rows(const noack_link *link);
int64_t noack_link_can_reorder(const noack_link *link);
int64_t noack_link_in_flight(const noack_link *link);

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

/* Apply other settings; return 0 if they are wrong. No packet waits in a scheduler's queue. latest_ns:
   (rows,) last departure time of the packets in flight; -1: none. */
int64_t noack_link_change(
    noack_link *link, const noack_link_settings *settings, const int64_t *latest_ns,
    const char **wrong);

/* Begin the flow of row 0 again, with other keys, (stage_count, 2): another run of a batch. */
void noack_link_renew(noack_link *link, const int64_t *keys, int64_t first_delivered);

/* ---- Parts of a decision, for predictions and tests ------------------------------------------ */

/* Whether the flow's next packet has to be delivered. */
int64_t noack_must_pass(const noack_link *link, int64_t row);

/* The earliest time, not before desired_ns, at which a packet may leave. */
int64_t noack_hold_back_until(
    const noack_link *link, int64_t row, int64_t packet, int64_t desired_ns);

/* Enforce the guarantee for a packet with known times, count it, and complete the decision. */
void noack_settle(noack_link *link, int64_t row, noack_decision *decision);

/* Whether a stage's queue has a free place; packets that have left until now_ns are removed. */
int64_t noack_queue_enters(noack_link *link, int64_t stage, int64_t now_ns);

/* Put a packet into a stage's queue, after noack_queue_enters; return its departure time. */
int64_t noack_queue_serve(noack_link *link, int64_t stage, int64_t size_bytes);

/* Quantile of the random delay, u in [0, 1). */
double noack_delay_quantile_ns(const noack_delay *delay, const double *reals, double u);

/* The normal distribution Phi(z), and its inverse. */
double noack_normal_cdf(double z);
double noack_normal_score(double u);

/* Random numbers: Philox4x32-10, and two numbers in [0, 1) of a pair for a packet; see random.c. */
void noack_philox(const int64_t counter[4], const int64_t key[2], int64_t words[4]);
void noack_uniforms(
    int64_t key0, int64_t key1, int64_t flow, int64_t packet, int64_t block, double uniform[2]);

/* A row of the record's table netem_packet. */
typedef struct {
    int64_t input, sequence, t_ns, now_ns, flow, fate, consecutive_losses;
    int64_t release_ns, copy_ns, bit, size_bytes;
    uint8_t head[NOACK_HEAD_BYTES];
} noack_packet_row;

/* A row of the record's table netem_release. */
typedef struct {
    int64_t input, sequence, t_ns, now_ns, flow, copy, stale;
} noack_release_row;
