/* A communication step [now, to): what is due at its end belongs to the next one, so that a
   controller that steps after the channel has each packet at its time. At equal times the order is
   that of native/driver/virtual.c. */
#include "fmi.h"

static const double MOST_S = 4e6, NS = 1e9; /* up to 46 days, a double has every nanosecond */

int64_t ns_of(double t_s) { return t_s >= 0.0 && t_s <= MOST_S ? (int64_t)(t_s * NS + 0.5) : -1; }

/* Put an arrival before the others. */
static void put_first(noack_fmu_image *image, int variable, int64_t words, const void *value) {
    uint8_t *values = values_of(image, variable);
    size_t bytes = (size_t)words * 8;
    memmove(values + bytes, values, bytes * (size_t)(image->packets - 1));
    memcpy(values, value, bytes);
}

static const char *arrive(noack_fmu_image *image, const noack_message *message, int64_t now_ns) {
    int64_t *arrivals = values_of(image, NOACK_FMU_ARRIVALS);
    int64_t *received = values_of(image, NOACK_FMU_RECEIVED);
    double sent_s = (double)message->t_ns / NS, now_s = (double)now_ns / NS;
    if (++*arrivals - image->arrivals_before > image->packets)
        return "more packets arrive in this step than `packets` has room for: make shorter steps";
    put_first(image, NOACK_FMU_NUMBERS, 1, &message->sequence);
    put_first(image, NOACK_FMU_SENT_S, 1, &sent_s);
    put_first(image, NOACK_FMU_ARRIVAL_S, 1, &now_s);
    put_first(image, NOACK_FMU_PACKETS, image->n, message->vector);
    if (message->sequence > *received) {
        *received = message->sequence;
        memcpy(values_of(image, NOACK_FMU_RECEIVED_S), &sent_s, sizeof sent_s);
        copy(image->n, message->vector, values_of(image, NOACK_FMU_RECEIVED_X));
    }
    return NULL;
}

/* What has just left the channel arrives, unless the network has damaged it. */
static const char *take_leaving(fmu *instance, int64_t now_ns) {
    noack_channel *channel = instance->channel;
    const char *wrong = NULL;
    channel->packet_count = channel->release_count = 0; /* there is no record */
    for (int64_t k = 0; wrong == NULL && k < channel->leaving_count; k++)
        if (channel->leaving[k].bit < 0)
            wrong = arrive(instance->image, &channel->leaving[k].message, now_ns);
    return wrong;
}

static const char *release_before(fmu *instance, int64_t to_ns) {
    const char *wrong = NULL;
    for (int64_t due_ns;
         wrong == NULL && (due_ns = noack_channel_due_ns(instance->channel)) < to_ns;) {
        noack_channel_release(instance->channel, due_ns);
        wrong = take_leaving(instance, due_ns);
    }
    return wrong;
}

static const char *send(fmu *instance) {
    noack_fmu_image *image = instance->image;
    noack_datagram datagram = {
        .size_bytes = NOACK_HEADER_BYTES + 8 * image->n + NOACK_TAG_BYTES,
        .arrival_ns = image->now_ns,
        .bit = -1,
        .message.flow = NOACK_UPDATE,
        .message.sequence = image->packets_taken++,
        .message.t_ns = image->now_ns,
        .message.entries = image->n,
    };
    copy(image->n, values_of(image, NOACK_FMU_X), datagram.message.vector);
    if (noack_channel_handle(instance->channel, &datagram, image->now_ns) != NOACK_DONE)
        return "too many packets are in flight";
    return take_leaving(instance, image->now_ns);
}

static const char *step_channel(fmu *instance, int64_t to_ns) {
    noack_fmu_image *image = instance->image;
    int64_t sent = *(int64_t *)values_of(image, NOACK_FMU_SEND);
    const char *wrong;
    image->arrivals_before = *(int64_t *)values_of(image, NOACK_FMU_ARRIVALS);
    if (!is_between(image->packets_taken, sent, image->packets_taken + 1))
        return "`send` must be as in the step before, or greater by 1: a packet in a step at most";
    if ((wrong = release_before(instance, image->now_ns + 1)) != NULL
        || (sent > image->packets_taken && (wrong = send(instance)) != NULL)
        || (wrong = release_before(instance, to_ns)) != NULL)
        return wrong;
    const noack_link *link = instance->channel->links[0];
    const noack_counters *counters = &link->counters;
    int64_t lost = counters->dropped + counters->overflowed + counters->blacked_out;
    *(int64_t *)values_of(image, NOACK_FMU_LOST) = lost + counters->corrupted;
    *(int64_t *)values_of(image, NOACK_FMU_LONGEST_BURST) = counters->longest_loss_burst;
    *(int64_t *)values_of(image, NOACK_FMU_IN_FLIGHT) = link->in_flight;
    return NULL;
}

/* The controller receives an arrival, unless it is stale. */
static void receive(fmu *instance, int64_t place) {
    const noack_fmu_image *image = instance->image;
    noack_reception *reception = &instance->controller->machine.received;
    noack_message message = {
        .flow = NOACK_UPDATE,
        .sequence = ((int64_t *)values_of(image, NOACK_FMU_NUMBERS))[place],
        .t_ns = ns_of(((double *)values_of(image, NOACK_FMU_SENT_S))[place]),
        .entries = image->n,
    };
    const double *packets = values_of(image, NOACK_FMU_PACKETS);
    copy(image->n, packets + place * image->n, message.vector);
    int64_t examination = noack_wire_examine_message(reception, 1, &message);
    if (examination == NOACK_ACCEPTED)
        noack_controller_handle(instance->controller, &message, image->now_ns, &instance->output);
    noack_wire_count(reception, examination, &message);
}

static const char *step_controller(fmu *instance, int64_t to_ns) {
    noack_fmu_image *image = instance->image;
    noack_controller *controller = instance->controller;
    const noack_machine *machine = &controller->machine;
    int64_t arrivals = *(int64_t *)values_of(image, NOACK_FMU_ARRIVALS);
    const double *arrival_s = values_of(image, NOACK_FMU_ARRIVAL_S);
    if (arrivals < image->packets_taken)
        return "`arrivals` counts all packets that have arrived: it must not decrease";
    if (!is_between(image->packets_taken, arrivals, image->packets_taken + image->packets))
        return "more packets have arrived than `packets` has room for: make shorter steps";
    for (;;) {
        int64_t place = arrivals - image->packets_taken - 1, due_ns = tick_ns(machine);
        int64_t arrival_ns = place >= 0 ? ns_of(arrival_s[place]) : INT64_MAX;
        if (arrival_ns < 0)
            return "`packet_arrival_s` of an arrival is not a time from 0 to 4,000,000 s";
        if (arrival_ns <= due_ns && arrival_ns < to_ns) {
            receive(instance, place);
            image->packets_taken++;
        } else if (due_ns < to_ns) {
            noack_controller_tick(controller, due_ns, &instance->output);
            copy(machine->m, instance->output.message.vector, values_of(image, NOACK_FMU_U));
        } else {
            break;
        }
    }
    copy(machine->n, controller->x_c, values_of(image, NOACK_FMU_X_C));
    *(int64_t *)values_of(image, NOACK_FMU_UPDATES) = machine->received.accepted;
    return NULL;
}

const char *step(fmu *instance, int64_t to_ns) {
    const char *wrong = instance->channel != NULL ? step_channel(instance, to_ns)
                                                  : step_controller(instance, to_ns);
    instance->image->now_ns = to_ns;
    *(double *)values_of(instance->image, NOACK_FMU_TIME_S) = (double)to_ns / NS;
    return wrong;
}
