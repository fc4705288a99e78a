/* Simulation in virtual time: all loops of a run and their network, without clock and sockets.

   A datagram arrives at the time of sending, unless the network delays it. So a simulated run
   equals a live run in which no deadline is missed. Order at equal times: the plants' steps,
   delayed datagrams from the network, datagrams in the order of sending, ticks of the controllers;
   steps and ticks in the order of the loops. Messages pass as structures: of a datagram, only what
   the record shows is written, unless the network has flipped a bit of it. */
#include <stdlib.h>

#include "channel.h"

enum { FIRST_PLACES = 256, MOST_OUTPUTS = 2 };

/* A datagram that has been sent and not received. */
typedef struct sent_datagram {
    int64_t to; /* enum noack_role, or NOACK_NETWORK */
    noack_datagram datagram;
} sent_datagram;

/* No datagram is rejected for its source, and none of it is read at a socket. */
enum { FROM_PEER = 1, OPENED = 0 };
static const int64_t UNKNOWN_ARRIVAL_NS = INT64_C(1) << 62;

static const int64_t RECEIVER[] = {
    [NOACK_MEASUREMENT] = NOACK_SENSOR,
    [NOACK_UPDATE] = NOACK_CONTROLLER,
    [NOACK_ACTUATION] = NOACK_PLANT,
    [NOACK_ACKNOWLEDGEMENT] = NOACK_SENSOR,
};

static const char *check(
    noack_process *const processes[3], const noack_channel *channel, const int64_t directions[5]) {
    for (int64_t role = NOACK_PLANT; role <= NOACK_CONTROLLER; role++)
        if (processes[role] == NULL || processes[role]->role != role
            || processes[role]->loops != channel->loops)
            return "the loops lack the machines of a role, or the network has other loops";
    for (int64_t flow = NOACK_MEASUREMENT; flow <= NOACK_ACKNOWLEDGEMENT; flow++)
        if (!is_between(-1, directions[flow], channel->directions - 1))
            return "a flow has no direction of the network";
    return NULL;
}

noack_simulation *noack_simulation_new(
    noack_process *const processes[3], noack_channel *channel, const noack_wire *wire,
    const int64_t directions[5], const char **wrong) {
    noack_simulation *simulation = NULL;
    if ((*wrong = check(processes, channel, directions)) == NULL)
        simulation = zeros(1, sizeof *simulation);
    if (simulation == NULL)
        return NULL;
    memcpy(simulation->processes, processes, sizeof simulation->processes);
    memcpy(simulation->directions, directions, sizeof simulation->directions);
    simulation->channel = channel;
    simulation->wire = *wire;
    return simulation;
}

void noack_simulation_free(noack_simulation *simulation) {
    if (simulation != NULL)
        free(simulation->sent);
    free(simulation);
}

/* Datagrams that have been sent. --------------------------------------------------------------- */

/* Double the ring; return 0 if there is no memory. */
static int add_places(noack_simulation *simulation) {
    int64_t places = simulation->sent_places, first = simulation->sent_first;
    sent_datagram *ring = zeros(max_of(2 * places, FIRST_PLACES), sizeof *ring);
    if (ring == NULL)
        return 0;
    if (places > 0) {
        memcpy(ring, simulation->sent + first, (size_t)(places - first) * sizeof *ring);
        memcpy(ring + places - first, simulation->sent, (size_t)first * sizeof *ring);
    }
    free(simulation->sent);
    simulation->sent = ring;
    simulation->sent_places = max_of(2 * places, FIRST_PLACES);
    simulation->sent_first = 0;
    return 1;
}

static sent_datagram *next_place(noack_simulation *simulation) {
    int64_t place = simulation->sent_first + simulation->sent_count++;
    return &simulation->sent[place & (simulation->sent_places - 1)];
}

static void remove_first(noack_simulation *simulation) {
    simulation->sent_first = (simulation->sent_first + 1) & (simulation->sent_places - 1);
    simulation->sent_count--;
}

/* Send the message of a machine, if there is one. */
static void send(noack_simulation *simulation, const noack_output *output) {
    if (!output->sends)
        return;
    const noack_message *message = &output->message;
    sent_datagram *sent = next_place(simulation);
    noack_datagram *datagram = &sent->datagram;
    int64_t direction = simulation->directions[message->flow];
    copy_message(&datagram->message, message);
    datagram->bit = -1;
    sent->to = RECEIVER[message->flow];
    if (direction < 0)
        return;
    sent->to = NOACK_NETWORK;
    datagram->flow = direction * simulation->channel->loops + message->loop;
    datagram->size_bytes = NOACK_HEADER_BYTES + 8 * message->entries + NOACK_TAG_BYTES;
    datagram->arrival_ns = UNKNOWN_ARRIVAL_NS;
    noack_wire_header(&simulation->wire, &datagram->message, datagram->head);
}

/* Forward what has left the network. */
static void forward(noack_simulation *simulation) {
    const noack_channel *channel = simulation->channel;
    for (int64_t i = 0; i < channel->leaving_count; i++) {
        sent_datagram *sent = next_place(simulation);
        copy_datagram(&sent->datagram, &channel->leaving[i]);
        sent->to = RECEIVER[sent->datagram.message.flow];
    }
}

/* Inputs of the machines. ---------------------------------------------------------------------- */

static int64_t asks(noack_simulation *simulation, int64_t who, int64_t question) {
    simulation->asking = who;
    return question;
}

static int64_t tick(noack_simulation *simulation, int64_t role) {
    noack_process *process = simulation->processes[role];
    int64_t question = noack_process_tick(process, simulation->now_ns);
    if (question != NOACK_DONE)
        return asks(simulation, role, question);
    send(simulation, &process->output);
    return NOACK_DONE;
}

static int64_t release(noack_simulation *simulation) {
    int64_t question = noack_channel_release(simulation->channel, simulation->now_ns);
    if (question != NOACK_DONE)
        return asks(simulation, NOACK_NETWORK, question);
    forward(simulation);
    return NOACK_DONE;
}

static int64_t cross(noack_simulation *simulation, const noack_datagram *datagram) {
    int64_t question = noack_channel_handle(simulation->channel, datagram, simulation->now_ns);
    if (question != NOACK_DONE)
        return asks(simulation, NOACK_NETWORK, question);
    remove_first(simulation);
    forward(simulation);
    return NOACK_DONE;
}

static noack_reception *reception_of(
    const noack_simulation *simulation, int64_t role, int64_t flow, int64_t loop) {
    noack_machine *machine = noack_process_machine(simulation->processes[role], loop);
    return flow == NOACK_ACKNOWLEDGEMENT ? &machine->acknowledgements : &machine->received;
}

/* Examine a datagram with a flipped bit, and count it: it is rejected. */
static void examine_flipped(
    const noack_simulation *simulation, int64_t role, const noack_datagram *datagram) {
    uint8_t data[NOACK_DATAGRAM_BYTES];
    noack_message message;
    int64_t size_bytes = noack_wire_encode(&simulation->wire, &datagram->message, data);
    data[datagram->bit / 8] ^= (uint8_t)(1 << (datagram->bit % 8));
    int64_t loop = header_loop(data, size_bytes);
    loop = loop < simulation->channel->loops ? loop
                                             : 0; /* its receiver rejects a datagram of no loop */
    noack_reception *reception = reception_of(simulation, role, datagram->message.flow, loop);
    int64_t examination = noack_wire_examine(
        &simulation->wire, reception, loop, data, size_bytes, FROM_PEER, OPENED, &message);
    noack_wire_count(reception, examination, &message);
}

/* Let a machine receive the first datagram. */
static int64_t receive(noack_simulation *simulation, int64_t role, noack_datagram *datagram) {
    noack_message *message = &datagram->message;
    if (datagram->bit >= 0) {
        examine_flipped(simulation, role, datagram);
        remove_first(simulation);
        return NOACK_DONE;
    }
    noack_reception *reception = reception_of(simulation, role, message->flow, message->loop);
    int64_t examination = noack_wire_examine_message(reception, FROM_PEER, message);
    if (message->entries != reception->entries)
        examination = NOACK_BAD_LENGTH;
    noack_process *process = simulation->processes[role];
    if (examination == NOACK_ACCEPTED) {
        int64_t question = noack_process_handle(process, message, simulation->now_ns);
        if (question != NOACK_DONE)
            return asks(simulation, role, question);
    }
    noack_wire_count(reception, examination, message);
    remove_first(simulation);
    if (examination == NOACK_ACCEPTED)
        send(simulation, &process->output);
    return NOACK_DONE;
}

/* The order of time. --------------------------------------------------------------------------- */

int64_t noack_simulate(noack_simulation *simulation, int64_t until_ns) {
    for (;;) {
        int64_t plants_ns = noack_process_due_ns(simulation->processes[NOACK_PLANT]);
        int64_t network_ns = noack_channel_due_ns(simulation->channel);
        int64_t sent_ns = simulation->sent_count > 0 ? simulation->now_ns : INT64_MAX;
        int64_t controllers_ns = noack_process_due_ns(simulation->processes[NOACK_CONTROLLER]);
        int64_t now_ns = min_of(min_of(plants_ns, network_ns), min_of(sent_ns, controllers_ns));
        if (now_ns == INT64_MAX || now_ns > until_ns)
            return NOACK_DONE;
        if (simulation->steps_left <= 0)
            return NOACK_STEPS_DONE;
        if (simulation->sent_count + MOST_OUTPUTS > simulation->sent_places
            && !add_places(simulation))
            return NOACK_NO_MEMORY;
        simulation->now_ns = now_ns;
        int64_t question;
        if (plants_ns == now_ns) {
            question = tick(simulation, NOACK_PLANT);
        } else if (network_ns == now_ns) {
            question = release(simulation);
        } else if (sent_ns == now_ns) {
            sent_datagram *first = &simulation->sent[simulation->sent_first];
            question = first->to == NOACK_NETWORK
                           ? cross(simulation, &first->datagram)
                           : receive(simulation, first->to, &first->datagram);
        } else {
            question = tick(simulation, NOACK_CONTROLLER);
        }
        if (question != NOACK_DONE)
            return question;
        simulation->steps_left--;
    }
}
