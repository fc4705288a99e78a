/* What the files of the network share: the state of a link, and what a stage does with a packet. */
#ifndef NOACK_NETWORK_H
#define NOACK_NETWORK_H

#include "../shared/shared.h"

#pragma GCC visibility push(default)
#include "public.h"
#pragma GCC visibility pop

/* run_header.c: the number in a header, not verified; -1: the datagram is too short. */
int64_t header_loop(const uint8_t *datagram, int64_t size_bytes);
int64_t header_flow(const uint8_t *datagram, int64_t size_bytes);

/* The error level in the header of an update, not verified; 0: there is none. */
int64_t header_error_level(const uint8_t *datagram, int64_t size_bytes);

/* A stage's memory of a flow. */
typedef struct {
    int64_t state; /* of a Markov chain, or 1: a score is stored */
    /* the slots of a schedule that begin before this time are taken; of an ordered delay, when the
       last packet has passed it */
    int64_t taken_until_ns;
    double score;    /* of the packet before */
    int64_t delayed; /* reorder: packets since the last one that left at once */
} noack_stage_memory;

/* A stage's state that all flows share: of a queue, whose departure times lie in a ring, or of a
   link that is good or bad. */
typedef struct {
    int64_t head, count;
    int64_t entry_ns;
    /* of a bottleneck: end of the last transmission; with a burst, when the bucket is empty.
       Opportunities: time of the last opportunity that was used */
    int64_t busy_until_ns;
    int64_t carry; /* fraction of a nanosecond, in units of 1/rate_bps */
    /* CoDel: the variables of RFC 8289, Section 5 */
    int64_t first_above_ns, drop_next_ns;
    int64_t drops; /* count_ of the RFC */
    int64_t last_drops, dropping;
    int64_t dropped_before; /* 1: the law dropped the previous packet; drop_next_ns is not new */
    /* opportunities: number of the one in use among those at busy_until_ns, from 1 */
    int64_t used;
    int64_t left_bytes;  /* bytes that it can still carry */
    int64_t total_bytes; /* all bytes that were put into the queue */
    /* Gilbert-Elliott, common to all flows: state, and number of its step */
    int64_t state, step;
    /* of the packets that wait until the link is free, the place + 1; 0: none */
    int64_t first_waiting;
    int64_t waiting_count, waiting_bytes;
} noack_stage_state;

/* A stored datagram that waits until the link is free; see native/network/waiting.c. */
struct noack_waiting {
    int64_t key, order, row, size_bytes, after_ns, earliest_ns;
    int64_t left, right, parent; /* the heap: places + 1; 0: none */
    int64_t before;              /* the place of the one before it in its flow, if that waits */
};

/* One direction of a link. */
struct noack_link {
    /* Settings: see noack_link_settings */
    int64_t stage_count, window_count;
    noack_stage *stages;
    int64_t *integers;
    double *reals;
    noack_window *windows;
    int64_t recovery, mansd, limit, can_reorder;
    /* the stage that chooses which packet of its queue the link sends next; -1: none */
    int64_t scheduler;

    /* State */
    int64_t rows;                    /* flows that have room */
    int64_t recent_width;            /* a power of 2, of mansd + 1 at least if it can reorder */
    int64_t loss_width;              /* a power of 2 */
    noack_flow *flows;               /* (rows,) */
    noack_stage_memory *memory;      /* (rows, stage_count) */
    int64_t *recent_ns;              /* (rows, recent_width) release times of the last packets */
    int64_t *losses;                 /* (rows, loss_width) numbers of losses so far, S */
    noack_stage_state *stage_states; /* (stage_count,) */
    int64_t *departures_ns;          /* the rings of the queues: two numbers for each packet */
    int64_t in_flight;               /* delayed packets and copies */
    noack_counters counters;
};

/* A packet is copied at most once. Each copy passes the later stages by itself. */
enum { ORIGINAL, DUPLICATE, COPIES };

/* One of the copies of a packet, between two stages. */
typedef struct {
    int exists;      /* 0: it is lost, or was never made */
    int64_t time_ns; /* when it has passed the stages so far */
    int64_t bit;     /* the bit that is flipped; -1: none */
    double score; /* normal score of the link's state, for a delay that is correlated with loss */
} packet_copy;

/* A packet for which a link decides, seen by a stage. */
typedef struct {
    noack_link *link;
    noack_flow *flow;
    noack_decision *decision;
    int64_t stage; /* its number */
    int copy;      /* the copy on which the stage acts */
    packet_copy copies[COPIES];
} packet;

typedef void stage_function(packet *packet, const noack_stage *stage, noack_stage_memory *memory);

/* Stages are called for every packet of a flow, lost or not, so that a stage's random draws do not
   depend on other stages. For a duplicate they are called once more, as if it were the flow's next
   packet; but later draws do not depend on that. */
stage_function apply_bernoulli, apply_four_state, apply_gilbert_elliott, apply_periodic,
    apply_scripted, apply_worst_case, apply_tail_drop, apply_blackout, apply_corrupt, apply_delay,
    apply_duplicate, apply_earliest_deadline, apply_maximum_error, apply_opportunities,
    apply_priority, apply_reorder, apply_replay, apply_schedule;

/* The copy on which a stage acts. */
static inline packet_copy *copy_in(packet *packet) { return &packet->copies[packet->copy]; }

/* Whether a packet that must pass has no other intact copy than this one. */
static inline int is_needed(const packet *packet) {
    const packet_copy *copy = &packet->copies[packet->copy];
    const packet_copy *other = &packet->copies[COPIES - 1 - packet->copy];
    return packet->decision->must_pass && copy->exists && copy->bit < 0
           && !(other->exists && other->bit < 0);
}

/* Lose the copy on which a stage acts by DROPPED, OVERFLOWED or BLACKED_OUT, unless it is lost
   already or needed. The packet has the fate of its last copy. */
static inline void lose(packet *packet, int64_t fate) {
    if (is_needed(packet)) {
        packet->decision->loss_suppressed = 1;
    } else if (copy_in(packet)->exists) {
        copy_in(packet)->exists = 0;
        if (!packet->copies[COPIES - 1 - packet->copy].exists)
            packet->decision->fate = fate;
    }
}

enum { MOST_DRAWS = 2 }; /* pairs of numbers that a stage needs for a copy */

/* Two uniform numbers in [0, 1) of a stage for the copy on which it acts; block numbers the pairs.
 */
static inline void draw(
    const packet *packet, const noack_stage *stage, int64_t block, double uniform[2]) {
    noack_uniforms(
        stage->key0, stage->key1, packet->flow->number, packet->decision->packet,
        packet->copy * MOST_DRAWS + block, uniform);
}

/* random.c: correlated random events. */
double latent(double correlation, double innovation, noack_stage_memory *memory, double u);
int happens(const noack_chance *chance, noack_stage_memory *memory, double u);

/* tail_drop.c: the bytes that a packet needs on the line of a bottleneck; the bytes that are in a
   queue at now_ns, from which what has left until then is removed; occupy a place in the queue. */
int64_t line_bytes_of(const noack_bottleneck *settings, int64_t size_bytes);
int64_t queue_bytes_at(noack_link *link, int64_t stage, int64_t now_ns);
void queue_occupy(noack_link *link, int64_t stage, int64_t until_ns, int64_t bytes);
/* In a queue each packet counts a byte at least, so that the number of packets is limited, too. */
static inline int64_t queued_bytes(int64_t line_bytes) { return max_of(line_bytes, 1); }
/* Whether the bytes that a bottleneck's queue may have leave room for a packet. */
static inline int fits_queue(
    const noack_bottleneck *settings, int64_t waiting_bytes, int64_t line_bytes) {
    return settings->queue_bytes == 0
           || waiting_bytes + queued_bytes(line_bytes) <= settings->queue_bytes;
}

/* codel.c: whether its law drops the packet that has just entered the queue, and drop it. */
int codel_is_due(const noack_link *link, int64_t stage);
void codel_drop(noack_link *link, int64_t stage, int64_t bytes);

/* guarantee.c */
int counts_losses(const noack_link *link);
int64_t make_stale(const noack_link *link, int64_t row, int64_t packet, int64_t release_ns);
void note_outcome(const noack_link *link, int64_t row, int64_t packet, int lost);

/* departures.c */

/* The row of the record of a decision; data: the datagram, of decision->size_bytes. */
noack_packet_row packet_row(
    const noack_decision *decision, int64_t input, int64_t arrival_ns, int64_t flow,
    const uint8_t *data);
/* Whether a datagram, or its copy, is the first of both that is intact. */
int is_first_intact(const noack_decision *decision, int copy);
/* At equal times, datagrams leave in order of direction, then of arrival, which is counted. */
int64_t departure_order(int64_t direction, int64_t delayed_count);

/* Whether the queue of a stage chooses when its link is free (waiting.c). */
static inline int is_scheduler(const noack_stage *stage) {
    return stage->kind == NOACK_PRIORITY || stage->kind == NOACK_EARLIEST_DEADLINE
           || stage->kind == NOACK_MAXIMUM_ERROR;
}

/* waiting.c: what the table of a stage has for a packet's flow: a priority, or a deadline in ns. */
int64_t flow_table_entry(const packet *packet, const noack_stage *stage);
/* Let a packet enter the queue of its stage; the packets with the smallest key + time leave first,
   of which those with the same leave in order of arrival. */
void enter_queue(packet *packet, int64_t key, int is_time);
/* Complete the decision for a packet that has entered, when all stages have seen it. */
void complete_waiting_decision(packet *packet);
/* Let a stored datagram, of whose link the decision is, wait until the link is free. */
void wait_for_link(
    noack_link *link, int64_t row, noack_waiting *waiting, int64_t place, int64_t order,
    const noack_decision *decision);
/* Begin to send what can begin until now_ns, and put it into the heap of departures. */
void serve(
    noack_link *link, noack_waiting *waiting, int64_t now_ns, noack_heap_entry *heap,
    int64_t *count);

/* link.c: decide by the stages, or, unless it is NULL, as the user's network did. */
void decide_for(
    noack_link *link, int64_t row, int64_t size_bytes, int64_t now_ns, const int64_t *outcome_ns,
    noack_decision *decision);

#endif
