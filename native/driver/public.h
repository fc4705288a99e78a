/* What drives the machines of a loop: real time, virtual time, events, recorded inputs. */

/* ---- The live driver: waits, receives, drives the machines of a process, sends --------------- */

/* Why noack_drive returned; after what Python does, it is called again. */
enum noack_driver_reason {
    NOACK_DRIVEN,          /* the time has come, or a signal: housekeeping */
    NOACK_DRIVER_ROWS,     /* a table of rows or notes must be emptied */
    NOACK_DRIVER_FAILED,   /* Python could not answer a machine */
    NOACK_DRIVER_OPEN,     /* decrypt the datagram in place; set opened */
    NOACK_DRIVER_SEAL,     /* encrypt the datagram in place, and write its tag */
    NOACK_DRIVER_NOTHING   /* within the driver only */
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
    int64_t opened;               /* a noack_opened, of the datagram below */
    uint8_t *datagram;
    int64_t datagram_bytes;
    struct driver_scratch *scratch;
    void *scratch_memory;
} noack_driver;

/* Return a driver; its machines must outlive it. */
noack_driver *noack_driver_new(
    noack_process *process, const noack_wire *wire, int64_t spin_ns, int64_t coalescing_ns,
    const char **wrong);
void noack_driver_free(noack_driver *driver);

/* Open the timer; return 0 or errno. */
int64_t noack_driver_open(noack_driver *driver);

/* Wait for its receivers, too, from now on; return 0 or errno. */
int64_t noack_driver_watch(noack_driver *driver);

/* Close the timer. */
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

/* A question of a channel besides NOACK_ASK_CHANGE and NOACK_ROWS_FULL. */
enum noack_channel_question {
    NOACK_ASK_OUTCOME = 16 /* the user's network: set outcome_ns for the datagram in asked */
};

/* Memory of delayed datagrams: native/driver/channel.c. */
typedef struct noack_delayed noack_delayed;

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
    struct sent_datagram *sent;   /* (sent_places,) a ring, in the order of sending */
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
