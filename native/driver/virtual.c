/* Simulation in virtual time: all loops of a run and their network, without clock and sockets.

   A datagram arrives at the time of sending, unless the network delays it. So a simulated run
   equals a live run in which no deadline is missed. Order at equal times: the plants' steps,
   delayed datagrams from the network, datagrams in the order of sending, ticks of the controllers;
   steps and ticks in the order of the loops. Messages pass as structures: of a datagram, only what
   the record shows is written, unless the network has flipped a bit of it. */
#include "../core.h"

enum { MOST_LOOPS = 65535, MOST_PLACES = 1 << 24, MOST_OUTPUTS = 2 };

/* No datagram is rejected for its source, and none of it is read at a socket. */
enum { FROM_PEER = 1, OPENED = 0 };
static const int64_t UNKNOWN_ARRIVAL_NS = INT64_C(1) << 62;

static const int64_t RECEIVER[] = {
    [NOACK_MEASUREMENT] = NOACK_SENSOR,
    [NOACK_UPDATE] = NOACK_CONTROLLER,
    [NOACK_ACTUATION] = NOACK_PLANT,
    [NOACK_ACKNOWLEDGEMENT] = NOACK_SENSOR,
};

static const char *check_group(const noack_simulation *simulation, int64_t number) {
    const noack_loop_group *group = &simulation->of_group[number];
    for (int64_t role = NOACK_PLANT; role <= NOACK_CONTROLLER; role++) {
        const noack_process *process = group->processes[role];
        if (process == NULL || process->role != role
            || process->loops != group->processes[NOACK_PLANT]->loops)
            return "a group of loops lacks the machines of a role";
    }
    for (int64_t place = 0; place < group->processes[NOACK_PLANT]->loops; place++) {
        int64_t loop = group->numbers[place];
        if (!is_between(0, loop, simulation->loops - 1) || simulation->of_loop[loop].group != number
            || simulation->of_loop[loop].place != place)
            return "a loop is not at its place in its group";
    }
    return NULL;
}

const char *noack_simulation_check(const noack_simulation *simulation) {
    const noack_channel *channel = simulation->channel;
    const char *wrong = noack_channel_check(channel);
    if (wrong != NULL)
        return wrong;
    if (!is_between(1, simulation->loops, MOST_LOOPS) || channel->loops != simulation->loops
        || !is_between(1, simulation->groups, simulation->loops))
        return "the network has another number of loops, or there are no loops";
    for (int64_t flow = NOACK_MEASUREMENT; flow <= NOACK_ACKNOWLEDGEMENT; flow++)
        if (!is_between(-1, simulation->directions[flow], channel->directions - 1))
            return "a flow crosses the network in no direction of it";
    int64_t places = simulation->sent_places;
    if (!is_between(MOST_OUTPUTS, places, MOST_PLACES) || (places & (places - 1)) != 0
        || !is_between(0, simulation->sent_count, places)
        || !is_between(0, simulation->sent_first, places - 1))
        return "there is no room for datagrams that have been sent";
    int64_t loops = 0;
    for (int64_t i = 0; i < simulation->groups; i++) {
        if ((wrong = check_group(simulation, i)) != NULL)
            return wrong;
        loops += simulation->of_group[i].processes[NOACK_PLANT]->loops;
    }
    return loops == simulation->loops ? NULL : "a loop is in no group";
}

/* Datagrams that have been sent. -----------------------------------------------------------------
 */

static noack_sent_datagram *next_place(noack_simulation *simulation) {
    int64_t place = simulation->sent_first + simulation->sent_count++;
    return &simulation->sent[place & (simulation->sent_places - 1)];
}

static void remove_first(noack_simulation *simulation) {
    simulation->sent_first = (simulation->sent_first + 1) & (simulation->sent_places - 1);
    simulation->sent_count--;
}

/* Send the message of a machine, if there is one. */
static void send(noack_simulation *simulation, int64_t group, const noack_output *output) {
    if (!output->sends)
        return;
    const noack_message *message = &output->message;
    noack_sent_datagram *sent = next_place(simulation);
    noack_datagram *datagram = &sent->datagram;
    int64_t direction = simulation->directions[message->flow];
    copy_message(&datagram->message, message);
    datagram->message.loop = simulation->of_group[group].numbers[message->loop];
    datagram->bit = -1;
    sent->to = RECEIVER[message->flow];
    if (direction < 0)
        return;
    sent->to = NOACK_NETWORK;
    datagram->flow = direction * simulation->loops + datagram->message.loop;
    datagram->size_bytes = NOACK_HEADER_BYTES + 8 * message->entries + NOACK_TAG_BYTES;
    datagram->arrival_ns = UNKNOWN_ARRIVAL_NS;
    wire_header(&simulation->wire, &datagram->message, datagram->head);
}

/* Forward what has left the network. */
static void forward(noack_simulation *simulation) {
    const noack_channel *channel = simulation->channel;
    for (int64_t i = 0; i < channel->leaving_count; i++) {
        noack_sent_datagram *sent = next_place(simulation);
        copy_datagram(&sent->datagram, &channel->leaving[i]);
        sent->to = RECEIVER[sent->datagram.message.flow];
    }
}

/* Inputs of the machines. ------------------------------------------------------------------------
 */

static int64_t ask(noack_simulation *simulation, int64_t who, int64_t group, int64_t question) {
    simulation->asking = who;
    simulation->asking_group = group;
    return question;
}

static int64_t tick(noack_simulation *simulation, int64_t role, int64_t group) {
    noack_process *process = simulation->of_group[group].processes[role];
    int64_t question = noack_process_tick(process, simulation->now_ns);
    if (question != NOACK_DONE)
        return ask(simulation, role, group, question);
    send(simulation, group, &process->output);
    return NOACK_DONE;
}

static int64_t release(noack_simulation *simulation) {
    int64_t question = noack_channel_release(simulation->channel, simulation->now_ns);
    if (question != NOACK_DONE)
        return ask(simulation, NOACK_NETWORK, 0, question);
    forward(simulation);
    return NOACK_DONE;
}

static int64_t cross(noack_simulation *simulation, const noack_datagram *datagram) {
    int64_t question = noack_channel_handle(simulation->channel, datagram, simulation->now_ns);
    if (question != NOACK_DONE)
        return ask(simulation, NOACK_NETWORK, 0, question);
    remove_first(simulation);
    forward(simulation);
    return NOACK_DONE;
}

static noack_reception *reception_of(
    const noack_simulation *simulation, int64_t role, int64_t flow, int64_t loop) {
    const noack_loop_place *place = &simulation->of_loop[loop];
    const noack_process *process = simulation->of_group[place->group].processes[role];
    noack_machine *machine = noack_process_machine(process, place->place);
    return flow == NOACK_ACKNOWLEDGEMENT ? &machine->acknowledgements : &machine->received;
}

/* Examine a datagram with a flipped bit, and count it: it is rejected. */
static void examine_flipped(
    const noack_simulation *simulation, int64_t role, const noack_datagram *datagram) {
    uint8_t data[NOACK_DATAGRAM_BYTES];
    noack_message message;
    int64_t size_bytes = noack_wire_encode(&simulation->wire, &datagram->message, data);
    data[datagram->bit / 8] ^= (uint8_t)(1 << (datagram->bit % 8));
    int64_t loop = noack_wire_loop(data, size_bytes);
    loop = loop < simulation->loops ? loop : 0; /* its receiver rejects a datagram of no loop */
    noack_reception *reception = reception_of(simulation, role, datagram->message.flow, loop);
    int64_t found = noack_wire_examine(
        &simulation->wire, reception, loop, data, size_bytes, FROM_PEER, OPENED, &message);
    noack_wire_count(reception, found, &message);
}

/* Let a machine receive the first datagram. */
static int64_t receive(noack_simulation *simulation, int64_t role, noack_datagram *datagram) {
    noack_message *message = &datagram->message;
    int64_t loop = message->loop;
    if (datagram->bit >= 0) {
        examine_flipped(simulation, role, datagram);
        remove_first(simulation);
        return NOACK_DONE;
    }
    noack_reception *reception = reception_of(simulation, role, message->flow, loop);
    int64_t found = wire_examine_message(reception, FROM_PEER, message);
    if (message->entries != reception->entries)
        found = NOACK_BAD_LENGTH;
    if (found == NOACK_ACCEPTED) {
        int64_t group = simulation->of_loop[loop].group;
        noack_process *process = simulation->of_group[group].processes[role];
        message->loop = simulation->of_loop[loop].place;
        int64_t question = noack_process_handle(process, message, simulation->now_ns);
        message->loop = loop;
        if (question != NOACK_DONE)
            return ask(simulation, role, group, question);
        noack_wire_count(reception, found, message);
        remove_first(simulation);
        send(simulation, group, &process->output);
        return NOACK_DONE;
    }
    noack_wire_count(reception, found, message);
    remove_first(simulation);
    return NOACK_DONE;
}

/* The order of time. -----------------------------------------------------------------------------
 */

/* The time of the next tick of a role; at equal times the group of the first loop ticks. */
static int64_t next_tick_ns(const noack_simulation *simulation, int64_t role, int64_t *group) {
    int64_t next_ns = INT64_MAX, first = 0;
    for (int64_t i = 0; i < simulation->groups; i++) {
        const noack_loop_group *one = &simulation->of_group[i];
        const noack_process *process = one->processes[role];
        int64_t due_ns = noack_process_due_ns(process);
        if (due_ns == INT64_MAX)
            continue;
        int64_t loop = one->numbers[process->heap[0]];
        if (due_ns < next_ns || (due_ns == next_ns && loop < first)) {
            next_ns = due_ns;
            first = loop;
            *group = i;
        }
    }
    return next_ns;
}

int64_t noack_simulate(noack_simulation *simulation, int64_t until_ns) {
    for (;;) {
        int64_t of_plants = 0, of_controllers = 0;
        int64_t plants_ns = next_tick_ns(simulation, NOACK_PLANT, &of_plants);
        int64_t network_ns = noack_channel_due_ns(simulation->channel);
        int64_t sent_ns = simulation->sent_count > 0 ? simulation->now_ns : INT64_MAX;
        int64_t controllers_ns = next_tick_ns(simulation, NOACK_CONTROLLER, &of_controllers);
        int64_t now_ns = min_of(min_of(plants_ns, network_ns), min_of(sent_ns, controllers_ns));
        if (now_ns == INT64_MAX || now_ns > until_ns)
            return NOACK_DONE;
        if (simulation->steps_left <= 0)
            return NOACK_STEPS_DONE;
        if (simulation->sent_count + MOST_OUTPUTS > simulation->sent_places)
            return NOACK_ASK_SENT_PLACES;
        simulation->now_ns = now_ns;
        int64_t question;
        if (plants_ns == now_ns) {
            question = tick(simulation, NOACK_PLANT, of_plants);
        } else if (network_ns == now_ns) {
            question = release(simulation);
        } else if (sent_ns == now_ns) {
            noack_sent_datagram *first = &simulation->sent[simulation->sent_first];
            question = first->to == NOACK_NETWORK
                           ? cross(simulation, &first->datagram)
                           : receive(simulation, first->to, &first->datagram);
        } else {
            question = tick(simulation, NOACK_CONTROLLER, of_controllers);
        }
        if (question != NOACK_DONE)
            return question;
        simulation->steps_left--;
    }
}
