/* Exact simulation in continuous time. */

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
    NOACK_EXACT_ROW,  /* all of a noack_exact_row */
    NOACK_EXACT_TIMES /* nothing but the times of events */
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

/* A simulation: what the runs share, and the memory of a run. */
typedef struct noack_exact noack_exact;

/* Its settings. Matrices are in row-major order. */
typedef struct {
    int64_t n, m;
    double *H, *K;           /* (n, n) of both models between updates; (m, n) the gain */
    /* symmetric weights of the cost, (n, n) and (m, m); NULL: the identity */
    double *Q, *R;
    const noack_trigger_rule *rule; /* must live longer */
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
} noack_exact_settings;

/* The events of runs: a row of places for each. */
typedef struct {
    int64_t places;
    double *event_s;    /* (runs, places) */
    uint8_t *delivered; /* likewise */
    double *states;     /* (runs, places, 3, n) just before the event; NULL: not wanted */
} noack_exact_log;

/* Return which of the processor's instructions runs use: 2: AVX2, FMA and registers of AVX-512;
   1: AVX2 and FMA; 0: neither, so that runs take many times as long. */
int64_t noack_exact_instructions(void);

/* Return a simulation with copies of the settings; its link must outlive it. The numbers of matrices
   and states may be any. */
noack_exact *noack_exact_new(const noack_exact_settings *settings, const char **wrong);
void noack_exact_free(noack_exact *exact);

/* Run every draw; a row depends on what the runs share and on its own draw only. A is (runs, n, n),
   B (runs, n, m), x0 (runs, n), keys (runs, stages of the link, 2). */
void noack_exact_runs(
    noack_exact *simulation, int64_t runs, const double *A, const double *B, const double *x0,
    const int64_t *keys, noack_exact_row *rows, const noack_exact_log *events);

/* States of a plant at ascending times. */
typedef struct {
    int64_t count;
    double *t_s;    /* (count,) */
    double *states; /* (count, 3, n) */
} noack_exact_states;

/* Fill samples with the states of a plant at their times, from the first start on. A start is a
   state just after an event; the last one up to a time applies. NAN where a million polynomials do
   not reach. */
void noack_exact_sample(
    noack_exact *simulation, const double *A, const double *B, const noack_exact_states *starts,
    noack_exact_states *samples);
