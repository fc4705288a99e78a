/* The core's one declaration of every structure and function that Python uses.

   native/build.py gives this file to cffi, and noack/core/core_library.py makes numpy's row types
   of it. Therefore it has declarations, enumerations and these comments only; every number is a
   double or an integer of a stated width. Times are integer nanoseconds. What noack_..._new returns
   owns its memory, until noack_..._free. Machines, link and simulators call no clock and no socket;
   the driver and the relay do.

   The comment of a field stands beside it, a long one above it. A blank line begins a group of
   fields, whose heading may follow. */

/* ---- Packets --------------------------------------------------------------------------------- */

enum {
    NOACK_NEVER_NS = -1,           /* a time that never comes */
    NOACK_OPPORTUNITY_BYTES = 1504 /* that a delivery opportunity of mahimahi carries */
};

/* What becomes of a packet, as noack.protocol.record_tables.Fate. */
enum noack_fate {
    NOACK_DELIVERED,
    NOACK_DROPPED,
    NOACK_FORCED,
    NOACK_CORRUPTED,
    NOACK_OVERFLOWED,
    NOACK_BLACKED_OUT
};

/* The decision for a packet; the stages modify it one after the other. */
typedef struct {
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

/* A rate limit; the stage's queue_places is the size of the queue. */
typedef struct {
    int64_t rate_bps;
    int64_t overhead_bytes;
    int64_t cell_bytes;
    int64_t cell_overhead_bytes;
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
        noack_schedule schedule;
    };
} noack_stage;

/* ---- State ----------------------------------------------------------------------------------- */

/* A stage's memory of a flow. */
typedef struct {
    int64_t state;          /* of a Markov chain, or 1: a score is stored */
    int64_t taken_until_ns; /* the slots of a schedule that begin before this time are taken */
    double score;           /* of the packet before */
} noack_stage_memory;

/* A link's state of a flow. */
typedef struct {
    int64_t number;             /* never used again on this link; selects its random numbers */
    int64_t forced_first;       /* 1: the first packet is still to come, and must be delivered */
    int64_t packets;            /* packets that have arrived */
    int64_t consecutive_losses; /* up to the last packet */
    /* no packet leaves before: departure time of the first one, if it had to be delivered; with a
       scheduler, of the last one; of the last one in flight at a change */
    int64_t first_release_ns;
    double score;               /* normal score of the link's state for the last packet */
    int64_t newest;             /* greatest number among the packets that have left intact */
    int64_t since;              /* number of the first packet under the present settings */
    int64_t error_level;        /* of the packet that arrives; 0: unknown. The caller sets it */
    int64_t waiting_count;      /* packets that wait until the link is free */
    int64_t last_waiting;       /* place of the last one */
    int64_t longest_loss_burst; /* since then; counts final losses only */
} noack_flow;

/* A stage's state that all flows share; departure times lie in a ring. */
typedef struct {
    int64_t head, count;
    int64_t entry_ns;
    int64_t busy_until_ns;  /* opportunities: time of the last opportunity that was used */
    int64_t carry;          /* fraction of a nanosecond, in units of 1/rate_bps */
    /* CoDel: the variables of RFC 8289, Section 5 */
    int64_t first_above_ns, drop_next_ns;
    int64_t drops;          /* count_ of the RFC */
    int64_t last_drops, dropping;
    int64_t dropped_before; /* 1: the law dropped the previous packet; drop_next_ns is not new */
    /* opportunities: number of the one in use among those at busy_until_ns, from 1 */
    int64_t used;
    int64_t left_bytes;     /* bytes that it can still carry */
    int64_t total_bytes;    /* all bytes that were put into the queue */
    /* Gilbert-Elliott, common to all flows: state, and number of its step */
    int64_t state, step;
    /* of the packets that wait until the link is free, the place + 1; 0: none */
    int64_t first_waiting;
    int64_t waiting_count;
} noack_queue;

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

/* One direction of a link: native/core.h. */
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
    int64_t tracks;                /* 1: packets can be delivered out of order */
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
int64_t noack_link_tracks(const noack_link *link);
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

/* ---- Arithmetic in a fixed order: the same bits on every processor --------------------------- */

/* result = M v; M is (rows, columns). The result must not overlap v. */
void noack_product(
    int64_t rows, int64_t columns, const double *matrix, const double *vector, double *result);

/* Each of `count` states, (count, n), becomes M^j times it, with its own j < 2^bits of `steps`,
   whose bits are followed from the lowest one. powers: M^(2^b), (bits, n, n); scratch: (n). */
void noack_advance_by_periods(
    int64_t n, int64_t bits, const double *powers, int64_t count, const int64_t *steps,
    double *states, double *scratch);

/* The Euclidean norm of a vector, without overflow of squares. */
double noack_norm(int64_t count, const double *vector);

/* e^x, e^x - 1, ln x, and the cube root of x >= 0. See native/elementary.h. */
double noack_exp(double x);
double noack_expm1(double x);
double noack_log(double x);
double noack_cube_root(double x);

/* result = e^M, (n, n); scratch: (10, n, n). See native/loop/exponential.c. */
void noack_exponential(int64_t n, const double *matrix, double *result, double *scratch);

/* ---- A trigger rule, and its condition since the last event ---------------------------------- */

/* A trigger rule, as noack.trigger_policies.trigger_rule has it. With z = (x, e_s), the sensor transmits as
   soon as |P z|^2 > max(c e^(-rho (t - t_0)), f)^2 + |N z|^2 + eta. */
typedef struct {
    double level, rate_per_s, floor; /* c, rho, f */
    int64_t since_ns;                /* t_0: 0, or the last change of a rate */
    int64_t from_event;              /* 1: t_0 is instead the last event, and c is |P z| just after it */
    int64_t integrates;              /* 1: the integral of |P z| since the last event is compared */
    int64_t is_dynamic;              /* 1: eta is Girard's dynamic variable */
    double decay_per_s;              /* of eta */
    double initial;                  /* eta at the start */
    int64_t grid_ns;                 /* the comparison counts at its multiples only; 0: always */
    int64_t idle_ns;                 /* it does not count before this time after an event */
    int64_t shortest_ns, longest_ns; /* the next event is due at the latest after longest_ns */
    int64_t forecasts;               /* 1: each event computes the time of the next one */
    /* the threshold that it forecasts */
    double beta, alpha_per_s, forecast_floor;
    double growth_per_s, mismatch_per_s, disturbance_per_s;
    int64_t positive_rows, negative_rows, positive_gain_rows, negative_gain_rows;
    double *positive, *negative;               /* P and N, (rows, 2n) */
    double *positive_gain, *negative_gain;     /* of the rate of eta: |P_eta z|^2 - |N_eta z|^2 */
    /* W of the norm that is recorded, (n, n); NULL: the identity */
    double *weight;
    /* of the norm of x that a forecast begins with; NULL: likewise */
    double *forecast_weight;
} noack_trigger_rule;

/* The condition of a trigger rule since the last event. */
typedef struct {
    double level;
    int64_t since_ns, earliest_ns, latest_ns;
    double auxiliary, rate; /* eta or the integral, and its rate at the last measurement */
    int64_t measured_ns;
    int64_t event_ns;       /* of the last event; -1: none yet */
} noack_trigger_state;

/* ---- The machines of a loop: plant, sensor, controller --------------------------------------- */

enum {
    NOACK_MAX_ENTRIES = 64, /* of a message's vector */
    NOACK_MAX_ROW_WORDS = 1024,
    NOACK_REJECTIONS = 10
};

enum noack_sequence { NOACK_NO_SEQUENCE = -1 };

/* What a message is, as noack.protocol.wire_format.Flow. */
enum noack_message_kind {
    NOACK_MEASUREMENT = 1,
    NOACK_UPDATE,
    NOACK_ACTUATION,
    NOACK_ACKNOWLEDGEMENT
};

/* What Python must do before a step goes on; the step is then repeated. */
enum noack_question {
    NOACK_DONE,         /* nothing: the step is done */
    NOACK_ASK_CHANGE,   /* other settings are due: set them, and change_ns */
    NOACK_ASK_SIGNALS,  /* the disturbances or the noise of the next steps are missing */
    NOACK_ASK_STATE,    /* advance the user's system: set x and z */
    NOACK_ASK_DECISION, /* the user's trigger: set event, left and right */
    NOACK_ASK_RESTART,  /* the user's trigger begins again with an acknowledged event */
    NOACK_ASK_UPDATE,   /* the user's control law receives the state of an update */
    NOACK_ASK_INPUT,    /* the user's control law: set u */
    NOACK_ASK_ROOM,     /* there is no room for another update that waits for its acknowledgement */
    NOACK_ROWS_FULL,    /* a table of rows or notes must be emptied */
    NOACK_NO_MEMORY     /* the step cannot be done */
};

/* A message of the loop, decoded. */
typedef struct {
    int64_t flow, loop, sequence, t_ns, entries;
    int64_t error_level; /* of an update: docs/wire.md; 0: none */
    double vector[NOACK_MAX_ENTRIES];
} noack_message;

/* What a machine receives of a flow. */
typedef struct {
    int64_t flow;
    int64_t entries;
    /* sequence number of the newest message accepted; -1: none */
    int64_t newest;
    int64_t not_after_ns;               /* later messages are out of range: no run has them */
    int64_t accepted;
    int64_t rejected[NOACK_REJECTIONS]; /* by noack.protocol.wire_format.Rejection */
} noack_reception;

/* A table of numbers that depend on a step's number only. */
typedef struct {
    int64_t width;  /* 0: there are none */
    int64_t first, rows;
    double *values; /* (rows, width) of the steps from first on */
} noack_signal;

/* The matrices e^(H dt) for the dt that occurred lately; loops with the same H may share them. */
typedef struct {
    int64_t n;
    int64_t is_static; /* 1: H = 0 */
    double *H;         /* (n, n) */
    int64_t places;    /* a power of 2 */
    int64_t *steps_ns; /* (places,) dt of each place; 0: free */
    double *matrices;  /* (places, n, n) */
    double *scratch;   /* (10 n n + 3n,) */
} noack_transitions;

/* The model between updates: dx/dt = H(x - x_r), x_r piecewise constant. */
typedef struct {
    noack_transitions *transitions;
    int64_t changes;    /* of x_r */
    int64_t *since_ns;  /* (changes,) ascending */
    int64_t *has_point; /* (changes + 1,) 0: x_r is 0 */
    double *points;     /* (changes + 1, n) */
} noack_model;

/* A period of ns + part / parts nanoseconds. */
typedef struct {
    int64_t ns, part, parts; /* 0 <= part < parts */
} noack_period;

/* What the machines of all roles have, first in each. */
typedef struct {
    int64_t n, m;
    /* time of the run at which the loop begins; other times are the loop's own */
    int64_t phase_ns;
    int64_t step;                /* number of the next tick */
    int64_t first_ns;            /* tick k is due at first_ns + the nearest whole ns to k T */
    noack_period period;         /* T; 0: no ticks */
    int64_t horizon_ns;          /* no tick is later */
    int64_t inputs;              /* number of the next input */
    /* time up to which the present settings have been used; -1: none */
    int64_t reached_ns;
    /* time from which other settings apply; INT64_MAX: none announced */
    int64_t change_ns;
    int64_t answered;            /* 1: Python has answered the question of this input */
    int64_t observed;            /* 1: the observer has taken this input */
    noack_reception received, acknowledgements;
} noack_machine;

/* What a plant applies when actuations are missing. */
enum noack_watchdog { NOACK_HOLD, NOACK_ZERO, NOACK_PREDICT };

/* What advances the state of a plant. */
enum noack_system {
    NOACK_LINEAR,
    NOACK_USER,  /* Python */
    NOACK_FAILED /* nothing: the state stays as it is */
};

enum noack_observer_kind { NOACK_NO_OBSERVER, NOACK_LUENBERGER, NOACK_KALMAN };

/* The machine of a plant; plant_server/plant.py makes it. */
typedef struct {
    noack_machine machine;

    /* Settings */
    int64_t internal;                       /* entries of z, the user's system's own state */
    int64_t system;                         /* enum noack_system */
    int64_t sources;                        /* columns of Bd: m, or m + n if x is disturbed */
    /* over a step of period.ns, (n, n) and (n, sources); behind each, if a part remains, those of
       a step that is 1 ns longer */
    double *Ad, *Bd;
    double *C;                              /* (p, n); NULL: the identity */
    int64_t p;
    noack_signal at_input, at_state, noise; /* d of each step, w of each step, v by measurement */
    int64_t measure_every;
    /* 1: a measurement has the inputs since the last one, too */
    int64_t reports_inputs;
    int64_t predictions;                    /* N, inputs of an actuation */
    int64_t carries_model;                  /* 1: an actuation has x_c, too */
    noack_period input_period;              /* of the controller */
    int64_t watchdog, timeout_ns, notice_ns;
    double *K;                              /* (m, n); used by NOACK_PREDICT only */
    noack_model fallback;                   /* dx/dt = H x; used by NOACK_PREDICT only */

    /* State */
    int64_t measurements;
    double *x, *z;                          /* (n,), (internal,) */
    double *u;                              /* (m,) held since the last step */
    double *applied;                        /* (sources,) the same, disturbed */
    /* (measure_every, m) the inputs since the last measurement, if reported */
    double *recent_inputs;
    double *inputs;                         /* (N, m) of the newest actuation */
    double *x_c;                            /* (n,) of it */
    int64_t newest_ns, newest_sequence;
    int64_t fallback_sequence, fallback_ns; /* of the actuation that the fallback follows */
    double *x_fallback;                     /* (n,) */
    /* since when actuations have been reported missing; -1: they are not */
    int64_t missing_ns;

    double *scratch;                        /* (2n + 2m,) */
} noack_plant;

/* The observer of a sensor. Luenberger: the gain is given. Kalman: it follows from P. */
typedef struct {
    int64_t kind;    /* enum noack_observer_kind */
    int64_t p;
    double *Ad, *Bd, *C;
    double *Q, *R;   /* (n, n), (p, p) */
    double *gain;    /* (n, p) */
    double *x, *P;   /* the state: (n,), (n, n) */
    int64_t t_ns;    /* time of the estimate; -1: that of the first measurement */
    double *scratch; /* (3 n n + n p + p p + 2n + p,) */
} noack_observer;

/* The machine of a sensor; sensor_node/sensor.py makes it. */
typedef struct {
    noack_machine machine;

    /* Settings */
    noack_model model;
    noack_trigger_rule rule;
    int64_t is_user;       /* 1: the user's trigger decides */
    int64_t acknowledged;  /* 1: only an acknowledged update resets x_s */
    int64_t timeout_ns;    /* of an acknowledgement */
    int64_t reports_error; /* 1: updates have an error level, by which the network chooses */
    noack_period plant_period;
    noack_observer observer;

    /* State */
    noack_trigger_state trigger;
    double *x_s;           /* (n,) */
    double *event_x;       /* (n,) x - x_r at the last event */
    int64_t model_ns;
    int64_t has_state;     /* 0: the first measurement is an event */
    int64_t events;        /* number of the next one */
    int64_t wait_ns;       /* time until which it waits for an acknowledgement; -1: it does not */
    int64_t sent_count, sent_places;
    /* (sent_places,) numbers of the updates not acknowledged, oldest first */
    int64_t *sent;
    double *sent_x;        /* (sent_places, n) */

    /* The question to the user's trigger, and its answer */
    double *x, *e_s;       /* (n,) the measured or estimated state; x_s - x */
    int64_t first;         /* 1: it starts at x first */
    int64_t asked_ns;      /* time of the measurement */
    int64_t event;
    double left, right;

    double *scratch;       /* (5n + rows of the rule's longest matrix,) */
} noack_sensor;

/* The machine of a controller; controller_node/controller.py makes it. */
typedef struct {
    noack_machine machine;

    /* Settings */
    noack_model model;
    double *K;                          /* (m, n) */
    int64_t has_point;                  /* 1: u = K(x_c - x_r) + u_r, else u = K x_c */
    double *x_r, *u_r;                  /* (n,), (m,) */
    double *safe_input;                 /* (m,) */
    int64_t is_user;                    /* 1: the user's control law gives u */
    int64_t acknowledges;
    int64_t predictions, carries_model; /* as of the plant */
    int64_t timeout_ns;                 /* age from which on an update is too old; above 0 */
    int64_t holds_input;                /* 1: it then holds its last input, else the safe input */

    /* State */
    double *x_c;                        /* (n,) */
    int64_t model_ns;
    int64_t has_state;
    int64_t newest;                     /* number of the last update; -1: none */
    int64_t update_ns;                  /* time of its event; 0: that of x(0) */
    /* (n,), (m,) the question to the user's law, and its answer; else the last input */
    double *x, *u;
    int64_t asked_ns;

    double *scratch;                    /* (3n + m,) */
} noack_controller;

/* What a machine does at an input: it writes a row, and may send a message. */
typedef struct {
    int64_t sends;                    /* 1: there is a message */
    noack_message message;
    int64_t notes;                    /* 1: a plant has written a note */
    int64_t table;                    /* enum noack_table_number, of the row */
    int64_t words;                    /* of the row */
    int64_t row[NOACK_MAX_ROW_WORDS]; /* integers, and the bits of doubles */
} noack_output;

/* A note of a plant: actuations are missing, or arrive again. */
typedef struct {
    int64_t loop, t_ns;
    int64_t since_ns; /* since when they were missing; -1: they are missing now */
    int64_t newest_ns, newest_sequence;
} noack_note;

enum noack_role { NOACK_PLANT, NOACK_SENSOR, NOACK_CONTROLLER };

/* The tables of rows of a machine; a sensor has no ticks. */
enum noack_table_number {
    NOACK_TICKS,
    NOACK_MESSAGES,
    NOACK_ACKNOWLEDGEMENTS,
    NOACK_TABLES
};

/* Bytes of the number of its loop, with which a row begins. */
enum { NOACK_LOOP_BYTES = 2 };

/* Words of a loop's row in a table whose vectors are longer than the loop's. */
enum noack_missing_word {
    NOACK_MISSING_NAN = -1,
    NOACK_MISSING_ZERO = -2
};

/* Rows of a table of the record, packed as numpy has them. */
typedef struct {
    int64_t row_bytes, places, count;
    uint8_t *rows; /* (places, row_bytes) */
    /* (loops,) for each word of a row: which word of the loop's own row it is, or a
       noack_missing_word; NULL: the rows of this loop, or of all loops, are those of the table */
    int64_t **layouts;
} noack_table;

/* An entry of a heap, by (due_ns, number): a delayed datagram, or the next tick of the loop of this
   number. */
typedef struct {
    int64_t due_ns, number;
    int64_t slot; /* of the datagram */
} noack_heap_entry;

/* The machines of one role, of all loops. */
typedef struct {
    int64_t role, loops;
    noack_plant *plants; /* (loops,) of this role; the others are NULL */
    noack_sensor *sensors;
    noack_controller *controllers;
    /* (loops,) the next tick of each machine that has one, in the run's time */
    noack_heap_entry *heap;
    int64_t heap_count;
    noack_table tables[NOACK_TABLES];
    noack_note *notes;
    int64_t note_places, note_count;
    noack_output output;
    int64_t asking;      /* the loop whose machine has asked */
} noack_process;

/* Return NULL, or what is wrong with the numbers of a process: all that the steps assume. */
const char *noack_process_check(const noack_process *process);

/* Find the first tick of each machine. */
void noack_process_begin(noack_process *process);

/* The next tick of all machines in the run's time; INT64_MAX: none. */
int64_t noack_process_due_ns(const noack_process *process);

/* A message arrives at now_ns, a time of the run; or the tick that is due is done. Return
   NOACK_DONE, or a noack_question: after the answer the call is repeated. */
int64_t noack_process_handle(
    noack_process *process, const noack_message *message, int64_t now_ns);

/* Do the first tick; noack_process_due_ns shows whether there is one. */
int64_t noack_process_tick(noack_process *process, int64_t now_ns);

/* The machine of a loop. */
noack_machine *noack_process_machine(const noack_process *process, int64_t loop);

/* Steps of one machine; times are the loop's own. They return as above. */
int64_t noack_plant_handle(
    noack_plant *plant, const noack_message *message, int64_t now_ns, noack_output *output);
int64_t noack_plant_tick(
    noack_plant *plant, int64_t now_ns, noack_output *output, noack_note *note);
int64_t noack_sensor_handle(
    noack_sensor *sensor, const noack_message *message, int64_t now_ns, noack_output *output);
int64_t noack_controller_handle(
    noack_controller *controller, const noack_message *message, int64_t now_ns,
    noack_output *output);
int64_t noack_controller_tick(
    noack_controller *controller, int64_t now_ns, noack_output *output);

/* ---- Parts of the steps, for other simulators and for tests ---------------------------------- */

/* Begin a trigger's state at x; or begin again at an event. */
void noack_trigger_start(
    const noack_trigger_rule *rule, noack_trigger_state *state, int64_t n, int64_t t_ns,
    const double *x, double *scratch);
void noack_trigger_restart(
    const noack_trigger_rule *rule, noack_trigger_state *state, int64_t n, int64_t t_ns,
    const double *x, double *scratch);

/* Set the threshold and the idle time as after an event at x. */
void noack_trigger_condition(
    const noack_trigger_rule *rule, noack_trigger_state *state, int64_t n, int64_t t_ns,
    const double *x, double *scratch);

/* Test a measurement: return whether there is an event, and both sides of the comparison. */
int64_t noack_trigger_test(
    const noack_trigger_rule *rule, noack_trigger_state *state, int64_t n, int64_t t_ns,
    const double *x, const double *e_s, double sides[2], double *scratch);

/* How long after an event at t_s, with |x| = norm, the next one is forecast. */
double noack_forecast_ns(const noack_trigger_rule *rule, double norm, double t_s);

/* The set point x_r at a time, (n,); NULL if it is 0. */
const double *noack_model_point(const noack_model *model, int64_t t_ns);

/* Advance a state x of the model to another time. */
void noack_model_advance(
    const noack_model *model, const double *x, int64_t from_ns, int64_t to_ns, double *result);

/* The matrix e^(H dt), which the next call may replace. */
const double *noack_transition(noack_transitions *transitions, int64_t dt_ns);

/* The steps of an observer: the prediction over a period, and the correction by a measurement, for
   which a Kalman filter computes its gain. */
void noack_observer_predict(noack_observer *observer, int64_t n, int64_t m, const double *u);
void noack_observer_gain(noack_observer *observer, int64_t n);
void noack_observer_correct(noack_observer *observer, int64_t n, const double *y);

/* ---- The clock of a run ---------------------------------------------------------------------- */

/* The clock of a run, as noack.core.clock: simulated time since the run's epoch. */
typedef struct {
    int64_t epoch_ns; /* reading of this host's monotonic clock at simulated time 0 */
    double speed;     /* simulated time per time of that clock */
} noack_clock;

/* The simulated time at a reading of this host's monotonic clock. */
int64_t noack_clock_at_ns(const noack_clock *clock, int64_t own_ns);

/* How long to wait on this host until simulated_ns has passed. */
int64_t noack_clock_wait_ns(const noack_clock *clock, int64_t simulated_ns);

typedef struct { /* of a driver that returns to Python for housekeeping */
    int64_t worked_since_wait; /* 1: it has worked since it last waited */
    int64_t worked_since_due;  /* 1: it has worked since housekeeping became due */
} noack_pauses;

/* How long to put off housekeeping that has been due for a time; 0: not at all. next_ns: the time
   until the next tick or departure. has_more: datagrams wait. is_busy: no pause is to be expected.
   All times are wall time. */
int64_t noack_put_off_ns(
    noack_pauses *pauses, int64_t overdue_ns, int64_t next_ns, int64_t has_more, int64_t is_busy);

/* ---- The wire format (docs/wire.md) ---------------------------------------------------------- */

enum {
    NOACK_HEADER_BYTES = 32,
    NOACK_TAG_BYTES = 16,
    NOACK_KEY_BYTES = 32,
    NOACK_DATAGRAM_BYTES = NOACK_HEADER_BYTES + 8 * NOACK_MAX_ENTRIES + NOACK_TAG_BYTES
};

/* What a datagram is; the first are those of noack.protocol.wire_format.Rejection. */
enum noack_examination {
    NOACK_BAD_LENGTH,
    NOACK_BAD_VERSION,
    NOACK_BAD_RUN,
    NOACK_BAD_FLOW,
    NOACK_BAD_LOOP,
    NOACK_BAD_TAG,
    NOACK_BAD_SOURCE,
    NOACK_BAD_RANGE,
    NOACK_STALE,
    NOACK_NOT_FINITE,
    NOACK_ACCEPTED,
    NOACK_ENCRYPTED /* Python must open it */
};

/* What the datagrams of a run have in common. */
typedef struct {
    int64_t run_id;    /* the bits of the unsigned number */
    int64_t encrypted; /* 1: Python encrypts and decrypts the vectors, and makes the tags */
    uint64_t keyed_state[8]; /* BLAKE2b's state after the key */
} noack_wire;

/* Set the key. */
void noack_wire_key(noack_wire *wire, const uint8_t key[NOACK_KEY_BYTES]);

/* Write the datagram of a message of at most NOACK_MAX_ENTRIES entries; return its size in bytes.
   If it is to be encrypted, its vector is still readable, and its tag missing. */
int64_t noack_wire_encode(const noack_wire *wire, const noack_message *message, uint8_t *datagram);

/* The number in a header, not verified; -1: the datagram is too short. */
int64_t noack_wire_loop(const uint8_t *datagram, int64_t size_bytes);
int64_t noack_wire_flow(const uint8_t *datagram, int64_t size_bytes);

/* The error level in the header of an update, not verified; 0: there is none. */
int64_t noack_wire_error_level(const uint8_t *datagram, int64_t size_bytes);

/* Examine a datagram that may be one of a loop; return a noack_examination. opened: 1 if Python has
   decrypted its vector in place. The message is complete if the datagram is accepted. */
int64_t noack_wire_examine(
    const noack_wire *wire, const noack_reception *reception, int64_t loop,
    const uint8_t *datagram, int64_t size_bytes, int64_t from_peer, int64_t opened,
    noack_message *message);

/* Count a datagram as accepted or rejected. */
void noack_wire_count(
    noack_reception *reception, int64_t examination, const noack_message *message);

/* ---- The live driver: waits, receives, drives the machines of a process, sends --------------- */

/* Why noack_drive returned; after what Python does, it is called again. */
enum noack_driver_reason {
    NOACK_DRIVEN,          /* the time has come, or a signal: housekeeping */
    NOACK_DRIVER_ROWS,     /* a table of rows or notes must be emptied */
    NOACK_DRIVER_QUESTION, /* a machine asks; question says what */
    NOACK_DRIVER_OPEN,     /* decrypt the datagram in place; set opened */
    NOACK_DRIVER_SEAL,     /* encrypt the datagram in place, and write its tag */
    NOACK_DRIVER_NOTHING   /* within the driver only */
};

enum {
    NOACK_NAME_BYTES = 40, /* room for a socket address (IPv6: 28 bytes), or a 5-tuple */
    NOACK_ERRNOS = 256
};

/* What Python found of an encrypted datagram. */
enum noack_opened { NOACK_NOT_OPENED, NOACK_OPENED, NOACK_NOT_AUTHENTIC };

/* A socket address from which messages come. */
typedef struct {
    int64_t name_bytes; /* 0: there is none */
    uint8_t name[NOACK_NAME_BYTES];
    int64_t received;   /* datagrams from this address */
} noack_peer;

/* The live driver of a process. Place 0 of its arrays is the flow of every run, place 1 that of the
   acknowledgements. */
typedef struct {
    noack_process *process;
    noack_wire wire;
    noack_clock clock;
    int64_t spin_ns;              /* time before a tick in which it does not sleep */
    /* if a tick is nearer after others, it sleeps so long, to do several */
    int64_t coalescing_ns;
    int64_t receiver_count;
    int64_t receivers[2];         /* sockets */
    int64_t senders[2];           /* sockets, connected to where the flows go; -1: none */
    int64_t timer;                /* a timerfd */
    int64_t epoll;                /* waits for the sockets and the timer */
    noack_peer sources[2];
    int64_t unknown_source;       /* datagrams from other addresses */
    int64_t sent;
    int64_t errors[NOACK_ERRNOS]; /* datagrams that could not be sent, by errno */
    int64_t question;             /* a noack_question */
    int64_t opened;               /* a noack_opened, of the datagram below */
    uint8_t *datagram;
    int64_t datagram_bytes;
    void *scratch;                /* noack_driver_scratch_bytes() bytes, which are 0 at first */
} noack_driver;

int64_t noack_driver_scratch_bytes(void);

/* Return NULL, or what is wrong with the numbers of a driver; its process has been checked. */
const char *noack_driver_check(const noack_driver *driver);

/* Prepare the scratch and the timer; return 0 or errno. */
int64_t noack_driver_open(noack_driver *driver);

/* Wait for its receivers, too, from now on; return 0 or errno. */
int64_t noack_driver_watch(noack_driver *driver);
void noack_driver_close(noack_driver *driver);

/* Work until a time of the run, or until Python is needed; return a noack_driver_reason. After
   until_ns it goes on for a while if a tick is near. INT64_MIN: do what is due, and do not wait. */
int64_t noack_drive(noack_driver *driver, int64_t until_ns);

/* Add a datagram as if it had just been received; then noack_drive must be called. */
void noack_driver_add_datagram(
    noack_driver *driver, const uint8_t name[NOACK_NAME_BYTES], const uint8_t *data,
    int64_t size_bytes);

/* Let woken processes run before the calling thread, whose time slice becomes 100 ms, where Linux
   has time slices of threads (since 6.12). */
void noack_prefer_others(void);

/* ---- The relay: waits for, receives, decides, sends ------------------------------------------ */

enum {
    NOACK_HEADERS_BYTES = 28,  /* of IPv4 and UDP; what follows in a packet is its payload */
    NOACK_HEAD_BYTES = 32,     /* of a payload, that a record has */
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

/* A datagram that is stored, or about to be sent. */
typedef struct {
    int64_t packet, arrival_ns, bit;
    int32_t size_bytes;
    int32_t block;  /* first block of the payload */
    int32_t direction, client;
    int32_t next;   /* next free slot */
    uint8_t copy;
    uint8_t counts; /* 1: it is the first intact copy */
    uint8_t unused[2];
} noack_slot;

/* A stored datagram that waits until the link is free; see native/network/waiting.c. */
typedef struct {
    int64_t key, order, row, size_bytes, after_ns, earliest_ns;
    int64_t left, right, parent; /* the heap: places + 1; 0: none */
    int64_t before;              /* the place of the one before it in its flow, if that waits */
} noack_waiting;

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
    noack_slot *slots;
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

/* ---- The network of a run, without sockets --------------------------------------------------- */

/* A datagram in the network. */
typedef struct {
    int64_t flow;                   /* its direction times loops, and its loop */
    int64_t size_bytes;
    int64_t arrival_ns;             /* at the socket; later than its handling: unknown */
    int64_t bit;                    /* the bit that the network has flipped; -1: none */
    uint8_t head[NOACK_HEAD_BYTES]; /* its first bytes */
    noack_message message;          /* what it carries, in a simulation */
} noack_datagram;

/* A delayed datagram or copy. */
typedef struct {
    int64_t packet;
    int64_t copy;
    int64_t counts;  /* 1: it is the datagram's first intact copy */
    int64_t delayed; /* 0: an overdue one was before it */
    int64_t next;    /* next free place */
    noack_datagram datagram;
} noack_delayed;

/* A question of a channel besides NOACK_ASK_CHANGE and NOACK_ROWS_FULL. */
enum noack_channel_question {
    NOACK_ASK_OUTCOME = 16 /* the user's network: set outcome_ns for the datagram in asked */
};

/* The network of a run in both directions; each flow has the row of its loop. */
typedef struct {
    int64_t loops;
    int64_t directions;          /* 1 or 2 */
    noack_link *links[2];        /* from the sensors; from the controllers */
    int64_t is_scripted;         /* 1: Python decides for what comes from the sensors */
    int64_t inputs;              /* number of the next input */
    int64_t reached_ns;          /* arrival of the last datagram; -1: none */
    /* time from which the first link has other settings; INT64_MAX: none */
    int64_t change_ns;
    int64_t answered;            /* 1: Python has decided for this datagram */
    int64_t outcome_ns;          /* its time from arrival to departure; -1: it is lost */
    noack_datagram asked;
    int64_t asked_ns;
    int64_t delayed_count;       /* datagrams that have been delayed so far */
    /* free_place: -1: none */
    int64_t heap_count, places, free_place;
    noack_heap_entry *heap;      /* (places,) */
    noack_delayed *delayed;      /* (places,) */
    noack_waiting *waiting;      /* (places,) */
    int64_t packet_count, release_count;
    noack_packet_row *packets;   /* (packet_count,) */
    noack_release_row *releases; /* (release_count,) */
    int64_t leaving_count;       /* of the last input: what leaves at once */
    noack_datagram leaving[2];
} noack_channel;

/* Return a channel; its links, (directions,), must outlive it. */
noack_channel *noack_channel_new(
    int64_t loops, int64_t directions, noack_link *const *links, int64_t is_scripted,
    const char **wrong);
void noack_channel_free(noack_channel *channel);

/* Time of the next departure; INT64_MAX: nothing is delayed. */
int64_t noack_channel_due_ns(const noack_channel *channel);

/* A datagram arrives, or what is due leaves; see leaving. Return NOACK_DONE, or a question: after
   the answer the call is repeated. The datagram's flow is one of the channel. */
int64_t noack_channel_handle(
    noack_channel *channel, const noack_datagram *datagram, int64_t now_ns);
int64_t noack_channel_release(noack_channel *channel, int64_t now_ns);

/* Last departure time of each flow of a direction, (loops,); the caller fills it with -1. */
void noack_channel_latest(noack_channel *channel, int64_t direction, int64_t *latest_ns);

/* ---- Simulation in virtual time -------------------------------------------------------------- */

/* Where a simulated datagram goes, besides enum noack_role. */
enum noack_destination {
    NOACK_NETWORK = 3
};

/* A datagram that has been sent and not received. */
typedef struct {
    int64_t to; /* enum noack_role, or NOACK_NETWORK */
    noack_datagram datagram;
} noack_sent_datagram;

/* Why a simulation returned, besides NOACK_DONE and the questions of who asks. */
enum noack_simulation_reason {
    NOACK_STEPS_DONE = 32 /* steps_left is 0 */
};

/* A simulation: the machines of all roles and the network between them. */
typedef struct {
    noack_process *processes[3]; /* by enum noack_role: the machines of all loops */
    noack_channel *channel;
    noack_wire wire;
    /* in which direction each flow crosses the network; -1: it does not */
    int64_t directions[5];
    int64_t now_ns;
    int64_t steps_left;          /* inputs of machines until it returns */
    int64_t asking;              /* enum noack_role or NOACK_NETWORK: who asks */
    int64_t sent_places;         /* a power of 2 */
    int64_t sent_first, sent_count;
    noack_sent_datagram *sent;   /* (sent_places,) a ring, in the order of sending */
} noack_simulation;

/* Return a simulation; the machines and the network must outlive it. */
noack_simulation *noack_simulation_new(
    noack_process *const processes[3], noack_channel *channel, const noack_wire *wire,
    const int64_t directions[5], const char **wrong);
void noack_simulation_free(noack_simulation *simulation);

/* Run until nothing is due up to until_ns. Return NOACK_DONE, or why Python is needed: after the
   answer the call is repeated. */
int64_t noack_simulate(noack_simulation *simulation, int64_t until_ns);

/* ---- Many runs of a loop, from event to event ------------------------------------------------ */

/* Many runs of a loop. The machines of one loop make the steps of all runs, one run after the
   other. */
typedef struct {
    noack_plant *plant;
    noack_sensor *sensor;
    noack_controller *controller;
    int64_t last;                 /* number of the last step of the plant */
    int64_t delay_ns;             /* of every delivered update */
    int64_t known_start;          /* 1: sensor and controller start from x(0) */
    const double *gains;          /* (measurements, n, p) of the observer; NULL: there is none */
    const double *weight;         /* W, (n, n) */
    /* (last + 1,) */
    const double *error_scale, *state_scale;

    /* The runs; r is the number of updates that may be in flight. */
    int64_t runs, places;
    int64_t *step;                /* (runs,) of the event before; -1: a start that is no event */
    double *x, *y, *x_s, *x_c;    /* (runs, n) y: measured or estimated */
    double *u, *u_next;           /* (runs, m) held, and of the newest actuation */
    /* (runs, r) step of each update in flight, the oldest first; -1: none */
    double *sent;
    double *updates;              /* (runs, r, n) */
    double *auxiliary;            /* (runs,) of the trigger */

    /* Of the segments since the event before */
    uint8_t *is_event;            /* (runs,) 1: it ended by an event */
    /* (runs,) largest scaled |W e_c| and |x|; infinite if the run diverged */
    double *error, *state;
    double *cost;                 /* (runs,) the integral of |x|^2, as a sum over the steps */
    int64_t *error_at, *state_at; /* (runs,) steps of the largest values */

    double *scratch;              /* (3n,) */
} noack_segments;

/* Return NULL, or what is wrong with the machines or the lengths. */
const char *noack_segments_check(const noack_segments *segments);

/* Advance each run to its next event, at most to a step, (runs,). tests: 0: there are no events. */
void noack_follow(noack_segments *segments, const int64_t *last, int64_t tests);

/* ---- Replay of recorded inputs --------------------------------------------------------------- */

/* Places of the entries of a vector in a row. */
typedef struct {
    int64_t begin, entries;
} noack_columns;

/* A further kind of noack_recorded_table. */
enum { NOACK_SETTINGS = NOACK_TABLES };

/* Rows of a table that a machine has written. */
typedef struct {
    int64_t kind;            /* enum noack_table_number; NOACK_SETTINGS: Python replays its rows */
    int64_t row_bytes;       /* without the number of the loop */
    int64_t stride;          /* bytes from one row to the next */
    int64_t count;
    const uint8_t *rows;
    noack_columns vector[3]; /* the vector of a message: places of bytes in a row */
} noack_recorded_table;

/* Why a replay returned, besides NOACK_DONE and the questions of the machine. */
enum noack_replay_reason {
    NOACK_REPLAY_SETTING = 64, /* the next input is a change of settings */
    NOACK_CANNOT_TAKE          /* the next input has values that no run has */
};

/* How the record differs from its replay. */
enum noack_difference {
    NOACK_EQUAL,
    NOACK_TIME_RUNS_BACKWARD,
    NOACK_BEFORE_DEADLINE,
    NOACK_OTHER_TABLE, /* the machine wrote a row of another table */
    NOACK_ROW_DIFFERS
};

/* The replay of a machine, or of the network. */
typedef struct {
    int64_t role;           /* enum noack_role, or NOACK_NETWORK */
    noack_process *process; /* of the machine, and the number of its loop there */
    int64_t loop;
    noack_channel *channel; /* of the network */
    noack_recorded_table tables[4];
    int64_t count, next;    /* inputs, and the next one */
    /* (count,) the inputs in order, as places among the rows of all tables */
    const int64_t *order;
    int64_t before_ns;      /* time of the input before */
    int64_t difference;     /* enum noack_difference: the first one */
    int64_t difference_at;  /* at which input */
    int64_t other_ns;       /* the time before, or the deadline; INT64_MAX: there is none */
    /* the row that the machine wrote then */
    uint8_t replayed[8 * NOACK_MAX_ROW_WORDS];

    /* What was sent. Of a message: flow, sequence number, time, vector and error level. Of a
       datagram: flow and head. There is room for a message of each input, or for two datagrams. */
    int64_t sent_width, sent_count;
    int64_t *sent;          /* (count or 2 count, sent_width) */
} noack_input_replay;

/* Return NULL, or what is wrong with the numbers of a replay. */
const char *noack_replay_check(const noack_input_replay *replay);

/* Replay the next inputs: compare each row bit for bit, and the times of ticks with the deadlines.
   Return NOACK_DONE, or why Python is needed. */
int64_t noack_replay_inputs(noack_input_replay *replay);

/* ---- Exact simulation in continuous time: native/exact/ -------------------------------------- */

/* The loop of plant, sensor's model and controller's model, without sampling and without delay.
   Times are in seconds. A state is (x, e_s, e_c) with e_s = x_s - x and e_c = x_c - x. */

/* The largest number of states, and of inputs. */
enum { NOACK_EXACT_ENTRIES = 64 };

/* How a run ended. */
enum noack_exact_status {
    NOACK_EXACT_OK,              /* at the horizon */
    NOACK_EXACT_DIVERGED,        /* the state, or its ratio to the threshold, exceeded 1e100 */
    NOACK_EXACT_TOO_MANY_EVENTS, /* more than are allowed, or two at the same time */
    /* a million steps do not decide whether a curve reaches its threshold or a measured level,
       because it stays too close to it; or a million polynomials do not reach the horizon, because
       the plant is too fast; or no polynomial is accurate */
    NOACK_EXACT_UNDECIDED
};

/* What is measured between events. */
enum noack_exact_measure {
    NOACK_EXACT_ROW,   /* all of a noack_exact_row */
    NOACK_EXACT_ERROR, /* the supremum of |W e_c| e^(rt) */
    NOACK_EXACT_STATE, /* the supremum of |x| e^(rt) */
    NOACK_EXACT_COST,  /* the integral of x'Qx + u'Ru */
    NOACK_EXACT_TIMES  /* nothing but the times of events */
};

/* The measures of a run; NAN where a number is not defined. */
typedef struct {
    int64_t transmissions, deliveries; /* until the end or the failure */
    int64_t longest_loss_burst;        /* likewise */
    /* NAN below two events */
    double inter_event_min_s, inter_event_mean_s;
    /* the last time at which |x| > settle |x(0)|; NAN: at the horizon, too */
    double settling_s;
    double cost;                       /* integral of x'Qx + u'Ru over the horizon, u = K x_c */
    /* supremum over the horizon of |W e_c| e^(rt), with the left limits at events; from event 0 on
       without a known start. Its relative error is at most 1e-10 (certified, not sampled) */
    double sup_e_c_scaled;
    double final_norm;                 /* |x| at the horizon */
    double diverged_at_s;
    /* unless it is NOACK_EXACT_OK, the measures of the whole run are NAN */
    int64_t status;
} noack_exact_row;

/* A simulation: what the runs share. Matrices are in row-major order. */
typedef struct {
    int64_t n, m;
    double *H, *K;           /* (n, n) of both models between updates; (m, n) the gain */
    /* symmetric weights of the cost, (n, n) and (m, m); NULL: the identity */
    double *Q, *R;
    noack_trigger_rule rule;
    noack_link *link;        /* with one flow; NULL: fates */
    int64_t first_delivered; /* of a link */
    int64_t fate_count;
    /* (fate_count,) 1: the update of this event arrives; later ones arrive */
    uint8_t *fates;
    double horizon_s;
    int64_t known_start;     /* 1: both models start from x(0); 0: from 0, with an event at t = 0 */
    double settle;           /* share of |x(0)| */
    int64_t most_events;
    int64_t measure;         /* enum noack_exact_measure */
    double fading_per_s;     /* r of the supremum */
    double fading_until_s;   /* r is 0 from this time on */

    /* The events of all runs: a row of event_places for each. */
    int64_t event_places;
    double *event_s;         /* (runs, event_places) */
    uint8_t *delivered;      /* likewise */
    /* (runs, event_places, 3, n) just before the event; NULL: not wanted */
    double *states;

    double *scratch;         /* noack_exact_scratch() numbers */
} noack_exact;

/* Return which of the processor's instructions runs use: 2: AVX2, FMA and registers of AVX-512;
   1: AVX2 and FMA; 0: neither, so that runs take many times as long. */
int64_t noack_exact_instructions(void);

/* Numbers of the scratch that n, m and the rule need; the other fields are not read. */
int64_t noack_exact_scratch(const noack_exact *exact);

/* Return NULL, or what is wrong: all that the functions below assume. The numbers of matrices and
   states may be any. */
const char *noack_exact_check(const noack_exact *exact);

/* Run every draw; a row depends on what the runs share and on its own draw only. A is (runs, n, n),
   B (runs, n, m), x0 (runs, n), keys (runs, stages of the link, 2). */
void noack_exact_runs(
    const noack_exact *exact, int64_t runs, const double *A, const double *B, const double *x0,
    const int64_t *keys, noack_exact_row *rows);

/* Segments of runs: from a state just after an event to the next event or the horizon. */
typedef struct {
    int64_t count;

    /* At the start; then at the end */
    double *t_s;         /* (count,) */
    double *states;      /* (count, 3, n) at an event before its reset */
    double *auxiliaries; /* (count,) eta or the integral of the trigger rule */

    /* At the end, (count,) each */
    int64_t *events;     /* 1: it ended by an event */
    double *values;      /* of the measure; NAN if it fails */
    double *at_s;        /* time of a supremum */
    int64_t *statuses;   /* enum noack_exact_status */
} noack_exact_segments;

/* States of a plant at ascending times. */
typedef struct {
    int64_t count;
    double *t_s;    /* (count,) */
    double *states; /* (count, 3, n) */
} noack_exact_states;

/* Follow a plant over segments. */
void noack_exact_follow(
    const noack_exact *exact, const double *A, const double *B, noack_exact_segments *segments);

/* Fill samples with the states of a plant at their times, from the first start on. A start is a
   state just after an event; the last one up to a time applies. NAN where a million polynomials do
   not reach. */
void noack_exact_sample(
    const noack_exact *exact, const double *A, const double *B, const noack_exact_states *starts,
    noack_exact_states *samples);
