/* The sensor: runs the model x_s in parallel to the plant and transmits at events (eq:ModSensor).

   Its step is noack_sensor_handle. At a measurement (handle_measurement):
   propagate x_s, test, send at most one state update. x_s is reset at every event, whether or not
   the network delivers the update: nothing is acknowledged. Its time is the time of the
   measurements: what it sends does not depend on when a datagram was read. With an observer the
   estimate x-hat takes the place of x. The trigger compares with x - x_r, the distance from the set
   point. Where the step needs Python, it asks.

   In the acknowledgement baseline only an acknowledged update resets x_s: at that of update k,
   x_s <- e^(H(t - t_k)) x(t_k), which equals the controller's model then. After a transmission the
   sensor waits for the acknowledgement until a timeout; then the current measurement is sent if the
   rule still requires it. An acknowledgement restarts the trigger's condition. */
#include <math.h>
#include <stdlib.h>

#include "loop.h"

enum { FIRST_PLACES = 64 }; /* of updates that wait for their acknowledgement */

/* x - x_r at a time. */
static const double *from_reference(const noack_sensor *sensor, int64_t t_ns, const double *x) {
    int64_t n = sensor->machine.n;
    double *difference = sensor->scratch + n;
    if (!noack_reference_at(sensor->model.reference, t_ns, 0, n, difference))
        return x;
    for (int64_t k = 0; k < n; k++)
        difference[k] = x[k] - difference[k];
    return difference;
}

/* Whether a measurement is an event, by the rule or by the answer of the user's trigger. */
static int64_t test_trigger(noack_sensor *sensor, int64_t t_ns, double sides[2]) {
    if (!sensor->is_user)
        return noack_trigger_test(
            sensor->rule, &sensor->trigger, t_ns, from_reference(sensor, t_ns, sensor->x),
            sensor->e_s, sides);
    sides[0] = sensor->left;
    sides[1] = sensor->right;
    return sensor->event;
}

/* Restart the condition of the trigger at an event at x. */
static void start_condition(noack_sensor *sensor, int64_t t_ns, const double *x) {
    int64_t n = sensor->machine.n;
    sensor->trigger.event_ns = t_ns;
    copy(n, from_reference(sensor, t_ns, x), sensor->event_x);
    if (!sensor->is_user)
        noack_trigger_start(sensor->rule, &sensor->trigger, t_ns, sensor->event_x);
}

/* An error, as a share of its threshold, on the scale of docs/wire.md: 1 to 255, of which 128 is 1,
   and 16 more are twice as much; 0: it is not a number. */
static int64_t error_level(double share) {
    int exponent;
    if (isnan(share))
        return 0;
    if (share >= 256.0)
        return 255;
    double fraction = frexp(fmax(share, 1.0 / 256.0), &exponent); /* 1/2 <= fraction < 1 */
    return max_of(96 + 16 * exponent + (int64_t)(32.0 * fraction), 1);
}

/* Write the row of a measurement and, at an event, the update. */
static void write_output(
    noack_sensor *sensor, const noack_message *message, const double *x_s, const double sides[2],
    int64_t event, int64_t now_ns, noack_output *output) {
    int64_t n = sensor->machine.n;
    const double *weight = sensor->rule->weight;
    double error = weight == NULL ? noack_norm(n, sensor->e_s)
                                  : image_norm(n, n, weight, sensor->e_s, sensor->rule->scratch);
    begin_row(output, NOACK_MESSAGES, &sensor->machine, message->sequence, message->t_ns, now_ns);
    put_reals(output, n, sensor->x);
    put_reals(output, n, x_s);
    put_reals(output, 1, &error);
    put_reals(output, 2, sides);
    put(output, event ? sensor->events : NOACK_NO_SEQUENCE);
    if (sensor->observer != NULL)
        put_reals(output, message->entries, message->vector);
    if (event) {
        begin_message(output, NOACK_UPDATE, sensor->events++, message->t_ns);
        append(output, n, sensor->x);
        if (sensor->reports_error) {
            int compares = sensor->is_user || sensor->rule->positive_rows > 0;
            double share = compares ? sides[0] / sides[1] : error;
            output->message.error_level = sensor->first ? 255 : error_level(share);
        }
    }
}

/* x_s at a measurement: at the first one it is x, or 0 until an update is acknowledged. */
static void advance_model(const noack_sensor *sensor, int64_t t_ns, double *x_s) {
    if (sensor->has_state)
        noack_model_advance(&sensor->model, sensor->x_s, sensor->model_ns, t_ns, x_s);
    else
        copy(sensor->machine.n, sensor->acknowledged ? sensor->x_s : sensor->x, x_s);
}

/* Make room for one more update that waits for its acknowledgement; return 0 if there is no memory.
 */
static int has_room(noack_sensor *sensor) {
    int64_t n = sensor->machine.n, before = sensor->sent_places;
    if (!sensor->acknowledged || sensor->sent_count < before)
        return 1;
    int64_t places = max_of(2 * before, FIRST_PLACES);
    if (!lengthen(&sensor->sent, before, places, sizeof *sensor->sent)
        || !lengthen(&sensor->sent_x, before * n, places * n, sizeof *sensor->sent_x))
        return 0;
    sensor->sent_places = places;
    return 1;
}

/* Keep a sent update until it is acknowledged, and start the timeout. */
static void keep_sent(noack_sensor *sensor, int64_t t_ns) {
    int64_t n = sensor->machine.n;
    copy(n, sensor->x, sensor->sent_x + sensor->sent_count * n);
    sensor->sent[sensor->sent_count++] = sensor->events;
    sensor->wait_ns = t_ns + sensor->timeout_ns;
}

static int64_t handle_measurement(
    noack_sensor *sensor, const noack_message *message, int64_t now_ns, noack_output *output) {
    noack_machine *machine = &sensor->machine;
    int64_t n = machine->n, t_ns = message->t_ns, first = !sensor->has_state;
    double *x_s = sensor->scratch, sides[2];
    if (!has_room(sensor))
        return NOACK_NO_MEMORY;
    advance_model(sensor, t_ns, x_s);
    for (int64_t k = 0; k < n; k++)
        sensor->e_s[k] = x_s[k] - sensor->x[k];
    sensor->first = first;
    sensor->asked_ns = t_ns;
    if (sensor->is_user && !ask(machine, NOACK_ASK_DECISION))
        return NOACK_NOT_ANSWERED;
    if (first)
        start_condition(sensor, t_ns, sensor->x);
    int64_t due = test_trigger(sensor, t_ns, sides);
    int64_t waits = sensor->acknowledged && t_ns < sensor->wait_ns;
    int64_t event = first || (due && !waits), resets = event && !sensor->acknowledged;
    if (resets)
        start_condition(sensor, t_ns, sensor->x);
    else if (event)
        keep_sent(sensor, t_ns);
    write_output(sensor, message, x_s, sides, event, now_ns, output);
    copy(n, resets ? sensor->x : x_s, sensor->x_s);
    sensor->model_ns = machine->reached_ns = t_ns;
    sensor->has_state = 1;
    return NOACK_DONE;
}

/* Index of an unacknowledged update; sent_count if there is none with this number. */
static int64_t find_sent(const noack_sensor *sensor, int64_t sequence) {
    int64_t place = 0;
    while (place < sensor->sent_count && sensor->sent[place] != sequence)
        place++;
    return place;
}

/* Drop the oldest updates: those up to the acknowledged one. */
static void drop_acknowledged(noack_sensor *sensor, int64_t count) {
    int64_t n = sensor->machine.n, left = sensor->sent_count - count;
    memmove(sensor->sent, sensor->sent + count, (size_t)left * sizeof *sensor->sent);
    memmove(
        sensor->sent_x, sensor->sent_x + count * n, (size_t)(left * n) * sizeof *sensor->sent_x);
    sensor->sent_count = left;
    if (left == 0)
        sensor->wait_ns = -1;
}

/* Acknowledgements arrive in order (older ones are rejected): the updates sent before this one are
   dropped, too. */
static int64_t handle_acknowledgement(
    noack_sensor *sensor, const noack_message *message, int64_t now_ns, noack_output *output) {
    noack_machine *machine = &sensor->machine;
    int64_t n = machine->n, t_ns = message->t_ns, place = find_sent(sensor, message->sequence);
    double *x_s_before = sensor->scratch;
    int is_unacknowledged = place < sensor->sent_count;
    copy(n, sensor->x_s, x_s_before);
    if (is_unacknowledged) {
        const double *x = sensor->sent_x + place * n;
        noack_model_advance(&sensor->model, x, t_ns, sensor->model_ns, sensor->x_s);
        sensor->trigger.event_ns = t_ns;
        copy(n, x, sensor->event_x);
        if (!sensor->is_user)
            noack_trigger_restart(sensor->rule, &sensor->trigger, t_ns, x);
        else if (!ask(machine, NOACK_ASK_RESTART))
            return NOACK_NOT_ANSWERED;
        drop_acknowledged(sensor, place + 1);
    }
    begin_row(output, NOACK_ACKNOWLEDGEMENTS, machine, message->sequence, t_ns, now_ns);
    put(output, sensor->model_ns);
    put_reals(output, n, x_s_before);
    put_reals(output, n, sensor->x_s);
    return NOACK_DONE;
}

int64_t noack_sensor_handle(
    noack_sensor *sensor, const noack_message *message, int64_t now_ns, noack_output *output) {
    noack_machine *machine = &sensor->machine;
    if (message->flow == NOACK_ACKNOWLEDGEMENT)
        return handle_acknowledgement(sensor, message, now_ns, output);
    while (message->t_ns >= machine->change_ns)
        if (!ask(machine, NOACK_ASK_CHANGE))
            return NOACK_NOT_ANSWERED;
    if (sensor->observer == NULL) {
        copy(machine->n, message->vector, sensor->x);
    } else {
        noack_observe(sensor->observer, message, &sensor->plant_period);
        copy(machine->n, sensor->observer->x, sensor->x);
    }
    return handle_measurement(sensor, message, now_ns, output);
}

/* How it is made. ------------------------------------------------------------------------------ */

/* Check the numbers of a new sensor, and complete them. */
static const char *check(noack_sensor *sensor) {
    noack_machine *machine = &sensor->machine;
    const noack_observer *observer = sensor->observer;
    machine->period = (noack_period){0, 0, 1};
    const char *wrong = begin_machine(machine, NOACK_MEASUREMENT);
    if (wrong != NULL)
        return wrong;
    machine->received.entries = machine->n;
    if (sensor->rule == NULL || sensor->rule->n != machine->n
        || !is_model(&sensor->model, machine->n, machine->n))
        return "a sensor has no rule or no model of its size";
    if (observer != NULL) {
        if (!is_between(machine->m, observer->reported, NOACK_MAX_ENTRIES)
            || observer->reported % machine->m != 0 || !is_period(&sensor->plant_period, 1))
            return "an observer receives measurements without the inputs applied";
        if (observer->p + observer->reported > NOACK_MAX_ENTRIES)
            return "a measurement has more than 64 entries";
        if (observer->n != machine->n || observer->m != machine->m)
            return "an observer has other sizes than its sensor";
        machine->received.entries = observer->p + observer->reported;
    }
    if (!is_between(0, sensor->timeout_ns, MOST_NS))
        return "a sensor has a timeout out of range";
    sensor->trigger = (noack_trigger_state){.event_ns = -1, .auxiliary = sensor->rule->initial};
    sensor->model_ns = sensor->events = sensor->sent_count = sensor->sent_places = 0;
    sensor->wait_ns = -1;
    sensor->sent = NULL;
    sensor->sent_x = NULL;
    return NULL;
}

noack_sensor *noack_sensor_new(const noack_sensor *settings, const char **wrong) {
    noack_sensor sensor = *settings;
    if ((*wrong = check(&sensor)) != NULL)
        return NULL;
    int64_t n = sensor.machine.n;
    owned_array arrays[] = {
        {&sensor.x_s, n, STATE}, {&sensor.event_x, n, STATE},     {&sensor.x, n, STATE},
        {&sensor.e_s, n, STATE}, {&sensor.scratch, 2 * n, STATE},
    };
    noack_sensor *new = with_arrays(&sensor, sizeof sensor, arrays, 5, NULL, wrong);
    if (new != NULL && new->has_state)
        start_condition(new, 0, new->x_s);
    return new;
}

void noack_sensor_free(noack_sensor *sensor) {
    free(sensor->sent);
    free(sensor->sent_x);
    free(sensor);
}
