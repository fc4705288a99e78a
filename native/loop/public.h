/* The machines of a loop, and the wire format of their messages.

   Each ..._new takes a structure with settings, and returns one with arrays and a state of its own,
   which Python reads and writes when a step asks. A state that is not given (NULL) is 0. What a
   handle points to must live longer: transitions, reference, rule and observer than a machine, the
   machines than their process. */

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

/* result = e^M, (n, n); scratch: (10, n, n). See native/loop/exponential.c. */
void noack_exponential(int64_t n, const double *matrix, double *result, double *scratch);

/* ---- A trigger rule, and its condition since the last event ---------------------------------- */

/* A trigger rule, as noack.trigger_policies.trigger_rule has it. With z = (x, e_s), the sensor transmits as
   soon as |P z|^2 > max(c e^(-rho (t - t_0)), f)^2 + |N z|^2 + eta. */
typedef struct {
    int64_t n;
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
    double *positive, *negative;               /* P and N, (rows, 2n); NULL: no rows */
    double *positive_gain, *negative_gain;     /* of the rate of eta: |P_eta z|^2 - |N_eta z|^2 */
    /* W of the norm that is recorded, (n, n); NULL: the identity */
    double *weight;
    /* of the norm of x that a forecast begins with; NULL: likewise */
    double *forecast_weight;
    double *scratch;                           /* (3n + rows of the longest matrix,) */
} noack_trigger_rule;

noack_trigger_rule *noack_trigger_rule_new(
    const noack_trigger_rule *settings, const char **wrong);
void noack_trigger_rule_free(noack_trigger_rule *rule);

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

/* What a step has come to; and what a machine asks Python for before its step goes on. */
enum noack_question {
    NOACK_DONE,         /* nothing: the step is done */
    NOACK_ASK_CHANGE,   /* other settings are due: set them, and change_ns */
    NOACK_ASK_SIGNALS,  /* the disturbances or the noise of the next steps are missing */
    NOACK_ASK_STATE,    /* advance the user's system: set x and z */
    NOACK_ASK_DECISION, /* the user's trigger: set event, left and right */
    NOACK_ASK_RESTART,  /* the user's trigger begins again with an acknowledged event */
    NOACK_ASK_UPDATE,   /* the user's control law receives the state of an update */
    NOACK_ASK_INPUT,    /* the user's control law: set u */
    NOACK_ROWS_FULL,    /* a table of rows or notes must be emptied; the step is then repeated */
    NOACK_NOT_ANSWERED, /* Python could not answer: the step was not done */
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

/* The matrices e^(H dt) for the dt that occurred lately; loops with the same H, (n, n), may share
   them. */
typedef struct noack_transitions noack_transitions;
noack_transitions *noack_transitions_new(int64_t n, const double *H, const char **wrong);
void noack_transitions_free(noack_transitions *transitions);

/* The matrix e^(H dt), which the next call may replace. */
const double *noack_transition(noack_transitions *transitions, int64_t dt_ns);

/* The reference x_r(t), u_r(t): segments, each a polynomial of the seconds since its begin, plus
   sine waves. The first begins at 0, and holds before that, too. */
typedef struct {
    int64_t width;         /* numbers of a row: n, or n + m with those of u_r */
    int64_t changes;       /* from one segment to the next */
    int64_t *since_ns;     /* (changes,) ascending */
    int64_t *is_zero;      /* (changes + 1,) 1: x_r and u_r are 0; not to be given */
    int64_t powers, waves; /* of each segment; at least 1, at least 0 */
    double *hz;            /* (changes + 1, waves) */
    double *rows;          /* (changes + 1, powers + 2 waves, width): of 1, t, ...; sine, cosine ... */
} noack_reference;

noack_reference *noack_reference_new(const noack_reference *settings, const char **wrong);
void noack_reference_free(noack_reference *reference);

/* The model between updates: d(x - x_r)/dt = H(x - x_r). */
typedef struct {
    noack_transitions *transitions;
    const noack_reference *reference; /* NULL: 0 */
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
    int64_t first_ns;            /* tick k is due at first_ns + the nearest whole ns to k T */
    noack_period period;         /* T; a sensor has no ticks */
    int64_t horizon_ns;          /* no tick is later, and no message's time */

    /* State */
    int64_t step;                /* number of the next tick */
    int64_t inputs;              /* number of the next input */
    /* time up to which the present settings have been used; -1: none */
    int64_t reached_ns;
    /* time from which other settings apply; INT64_MAX: none announced */
    int64_t change_ns;
    int64_t loop;                /* its number in its process */
    /* Python does what a step needs; 0: it is done. Not slower than returning the question and
       repeating the step: by 0.4 to 1 us a question it was faster. */
    int64_t (*ask)(int64_t loop, int64_t question);
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

enum noack_observer_kind { NOACK_LUENBERGER, NOACK_KALMAN };

/* The machine of a plant; plant_server/plant.py describes it. */
typedef struct {
    noack_machine machine;

    /* Settings */
    int64_t internal;                       /* entries of z, the user's system's own state */
    int64_t system;                         /* enum noack_system */
    int64_t sources;                        /* columns of Bd: m + at_state.width */
    /* over a step of period.ns, (n, n) and (n, sources); behind each, if a part remains, those of
       a step that is 1 ns longer */
    double *Ad, *Bd;
    double *C;                              /* (p, n); NULL: the identity, p is n */
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

noack_plant *noack_plant_new(const noack_plant *settings, const char **wrong);
void noack_plant_free(noack_plant *plant);

/* The observer of a sensor. Luenberger: the gain is given. Kalman: those of the first measurements are
   given, the last one for all later ones, until a measurement is missing; else it follows from P. */
typedef struct {
    int64_t kind;         /* enum noack_observer_kind */
    int64_t n, m, p;
    int64_t reported;     /* entries of a measurement that are inputs applied, behind y */
    double *Ad, *Bd, *C;
    double *Q, *R;        /* (n, n), (p, p) */
    double *gain;         /* (n, p); of a Kalman filter not to be given */
    double *first_gain;   /* (n, p) at the first measurement; NULL: gain */
    double *gains;        /* (gain_count, n, p) of a Kalman filter; NULL: none is given */
    int64_t gain_count;
    double *x, *P;        /* the state: (n,), (n, n) */
    int64_t t_ns;         /* time of the estimate; -1: that of the first measurement */
    int64_t corrections;  /* measurements so far */
    int64_t has_gap;      /* 1: a measurement was missing */
    double *scratch;      /* (3 n n + n p + p p + 2n + p,) */
} noack_observer;

noack_observer *noack_observer_new(const noack_observer *settings, const char **wrong);
void noack_observer_free(noack_observer *observer);

/* The machine of a sensor; sensor_node/sensor.py describes it. */
typedef struct {
    noack_machine machine;

    /* Settings */
    noack_model model;
    const noack_trigger_rule *rule; /* of a user's trigger only its weight counts */
    int64_t is_user;       /* 1: the user's trigger decides */
    int64_t acknowledged;  /* 1: only an acknowledged update resets x_s */
    int64_t timeout_ns;    /* of an acknowledgement */
    int64_t reports_error; /* 1: updates have an error level, by which the network chooses */
    noack_period plant_period;
    noack_observer *observer; /* NULL: none */

    /* State */
    noack_trigger_state trigger;
    double *x_s;           /* (n,) at the start that of the settings */
    double *event_x;       /* (n,) x - x_r at the last event */
    int64_t model_ns;
    int64_t has_state;     /* of the settings: 0: the first measurement is an event */
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

    double *scratch;       /* (2n,) */
} noack_sensor;

noack_sensor *noack_sensor_new(const noack_sensor *settings, const char **wrong);
void noack_sensor_free(noack_sensor *sensor);

/* The machine of a controller; controller_node/controller.py describes it. */
typedef struct {
    noack_machine machine;

    /* Settings */
    noack_model model;
    double *K;                          /* (m, n): u = K(x_c - x_r) + u_r; of a user's law 0 */
    double *safe_input;                 /* (m,) */
    int64_t is_user;                    /* 1: the user's control law gives u */
    int64_t acknowledges;
    int64_t predictions, carries_model; /* as of the plant */
    int64_t timeout_ns;                 /* age from which on an update is too old; above 0 */
    int64_t holds_input;                /* 1: it then holds its last input, else the safe input */

    /* State */
    double *x_c;                        /* (n,) at the start that of the settings */
    int64_t model_ns;
    int64_t has_state;                  /* of the settings: 0: there is no x_c before an update */
    int64_t newest;                     /* number of the last update; -1: none */
    int64_t update_ns;                  /* time of its event; 0: that of x(0) */
    /* (n,), (m,) the question to the user's law, and its answer; else the last input */
    double *x, *u;
    int64_t asked_ns;

    double *scratch;                    /* (3n + 2m,) */
} noack_controller;

noack_controller *noack_controller_new(const noack_controller *settings, const char **wrong);
void noack_controller_free(noack_controller *controller);

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

enum { NOACK_NOTES = 256 }; /* for which there is room until they are taken */

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
    uint8_t *rows; /* (places, row_bytes), of the caller, who may give other rows between steps */
    /* (kinds, words) for each word of a row: which word of a loop's own row it is, or a
       noack_missing_word; NULL: the rows of all loops are those of the table */
    int64_t kinds;
    int64_t *layouts;
    int64_t *kind_of; /* (loops,) which layout each loop has */
} noack_table;

/* The machines of one role, of all loops. */
typedef struct {
    int64_t role, loops;
    noack_machine **machines; /* (loops,) */
    /* (loops,) the next tick of each machine that has one, in the run's time */
    noack_heap_entry *heap;
    int64_t heap_count;
    noack_table tables[NOACK_TABLES];
    noack_note *notes;        /* (NOACK_NOTES,) */
    int64_t note_count;
    noack_output output;
    int64_t has_asked;        /* 1: since the driver set it to 0, a machine has asked */
} noack_process;

/* Return a process of new machines, which ask by a function of Python, and of the tables that these
   machines write: row_bytes, places, rows, and kinds with their layouts. */
noack_process *noack_process_new(
    int64_t role, int64_t loops, noack_machine *const *machines,
    int64_t (*ask)(int64_t loop, int64_t question), const noack_table *tables,
    const char **wrong);
void noack_process_free(noack_process *process);

/* The next tick of all machines in the run's time; INT64_MAX: none. */
int64_t noack_process_due_ns(const noack_process *process);

/* A message arrives at now_ns, a time of the run; or the tick that is due is done. Return
   NOACK_DONE, NOACK_ROWS_FULL or NOACK_NOT_ANSWERED. */
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
    const noack_trigger_rule *rule, noack_trigger_state *state, int64_t t_ns, const double *x);
void noack_trigger_restart(
    const noack_trigger_rule *rule, noack_trigger_state *state, int64_t t_ns, const double *x);

/* Set the threshold and the idle time as after an event at x. */
void noack_trigger_condition(
    const noack_trigger_rule *rule, noack_trigger_state *state, int64_t t_ns, const double *x);

/* Test a measurement: return whether there is an event, and both sides of the comparison. */
int64_t noack_trigger_test(
    const noack_trigger_rule *rule, noack_trigger_state *state, int64_t t_ns, const double *x,
    const double *e_s, double sides[2]);

/* How long after an event at t_s, with |x| = norm, the next one is forecast. */
double noack_forecast_ns(const noack_trigger_rule *rule, double norm, double t_s);

/* Numbers of a segment of the reference at a time: count of them from the first on. */
void noack_reference_part(
    const noack_reference *reference, int64_t segment, int64_t t_ns, int64_t first, int64_t count,
    double *result);

/* The same of the segment of that time; return 0, without a result, if it is zero. */
int64_t noack_reference_at(
    const noack_reference *reference, int64_t t_ns, int64_t first, int64_t count, double *result);

/* All numbers at several times; result is (count, width). */
void noack_reference_rows(
    const noack_reference *reference, int64_t count, const int64_t *t_ns, double *result);

/* Advance a state x of the model to another time. */
void noack_model_advance(
    const noack_model *model, const double *x, int64_t from_ns, int64_t to_ns, double *result);

/* The steps of an observer: the prediction over a period, and the correction by a measurement, for
   which a Kalman filter computes its gain. */
void noack_observer_predict(noack_observer *observer, const double *u);
void noack_observer_gain(noack_observer *observer);
void noack_observer_correct(noack_observer *observer, const double *y);

/* ---- The wire format (docs/wire.md) ---------------------------------------------------------- */

enum {
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

/* Examine a datagram that may be one of a loop; return a noack_examination. opened: 1 if Python has
   decrypted its vector in place. The message is complete if the datagram is accepted. */
int64_t noack_wire_examine(
    const noack_wire *wire, const noack_reception *reception, int64_t loop,
    const uint8_t *datagram, int64_t size_bytes, int64_t from_peer, int64_t opened,
    noack_message *message);

/* Count a datagram as accepted or rejected. */
void noack_wire_count(
    noack_reception *reception, int64_t examination, const noack_message *message);
