/* A channel with a static schedule: slots of a fixed length, in a periodic order, each for one
   flow.

   A packet leaves at the begin of its flow's first own slot that is neither before its arrival nor
   taken; one that arrives just then leaves at once. A packet that finds as many own slots after its
   arrival taken as may be is lost. A flow without a slot loses what need not pass; what must pass
   leaves at once, outside of the schedule.

   The slots of a flow do not depend on other flows. Hence the time until which they are taken is
   all that is remembered, and a departure is known on arrival. Own slots are counted over all
   rounds. The flows are rows of the link: the loops of a run, or the clients of a relay. */
#include "../network/network.h"

/* The own slots of a flow: their numbers in a round, ascending. */
typedef struct {
    const noack_schedule *settings;
    const int64_t *slots;
    int64_t count;
} turns;

/* The number of the first own slot that begins at a time, or later. */
static int64_t turn_from(const turns *turns, int64_t now_ns) {
    int64_t before =
        floor_div(now_ns - 1, turns->settings->slot_ns); /* the last slot that is too early */
    int64_t round = floor_div(before, turns->settings->slots);
    int64_t place =
        first_above(turns->slots, 0, turns->count, before - round * turns->settings->slots);
    return round * turns->count + place;
}

/* The begin of an own slot. */
static int64_t turn_ns(const turns *turns, int64_t number) {
    int64_t round = floor_div(number, turns->count);
    int64_t slot = round * turns->settings->slots + turns->slots[floor_mod(number, turns->count)];
    return min_of(slot * turns->settings->slot_ns, LATEST_NS);
}

/* Whether a packet that arrives at now_ns finds few enough slots taken. */
static int has_room(const turns *turns, const noack_stage_memory *memory, int64_t now_ns) {
    int64_t number = turn_from(turns, max_of(now_ns, memory->taken_until_ns));
    return number - turn_from(turns, now_ns + 1) < turns->settings->queue;
}

/* Take a slot for a packet that arrives at now_ns; return its begin. */
static int64_t take_turn(const turns *turns, noack_stage_memory *memory, int64_t now_ns) {
    int64_t begin_ns = turn_ns(turns, turn_from(turns, max_of(now_ns, memory->taken_until_ns)));
    memory->taken_until_ns = begin_ns + 1;
    return begin_ns;
}

/* Take a slot; ignore a packet that is lost already. */
void apply_schedule(packet *packet, const noack_stage *stage, noack_stage_memory *memory) {
    packet_copy *copy = copy_in(packet);
    const int64_t *firsts = packet->link->integers + stage->schedule.begin;
    int64_t row = packet->flow - packet->link->flows, flows = stage->schedule.flows;
    turns turns = {&stage->schedule, firsts + flows + 1, 0};
    if (!copy->exists)
        return;
    if (row < flows) {
        turns.slots += firsts[row];
        turns.count = firsts[row + 1] - firsts[row];
    }
    if (turns.count == 0 || !has_room(&turns, memory, copy->time_ns))
        lose(packet, NOACK_OVERFLOWED);
    if (copy->exists && turns.count > 0)
        copy->time_ns = take_turn(&turns, memory, copy->time_ns);
}
