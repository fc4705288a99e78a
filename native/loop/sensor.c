/* The sensor: runs the model x_s in parallel to the plant and transmits at events (eq:ModSensor).

   Its step is noack_sensor_handle, at the end of this file. At a measurement (handle_measurement):
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

#include "loop.h"

/* The scratch of the trigger; before it are x_s and x - x_r. */
static double *rule_scratch(const noack_sensor *sensor) {
    return sensor->scratch + 2 * sensor->machine.n;
}

/* x - x_r at a time. */
static const double *from_reference(const noack_sensor *sensor, int64_t t_ns, const double *x) {
    int64_t n = sensor->machine.n;
    double *difference = sensor->scratch + n;
    if (!noack_reference_at(&sensor->model.reference, t_ns, 0, n, difference))
        return x;
    for (int64_t k = 0; k < n; k++)
        difference[k] = x[k] - difference[k];
    return difference;
}

/* Whether a measurement is an event, by the rule or by the answer of the user's trigger. */
static int64_t test_trigger(noack_sensor *sensor, int64_t t_ns, double sides[2]) {
    if (!sensor->is_user)
        return noack_trigger_test(
            &sensor->rule, &sensor->trigger, sensor->machine.n, t_ns,
            from_reference(sensor, t_ns, sensor->x), sensor->e_s, sides, rule_scratch(sensor));
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
        noack_trigger_start(
            &sensor->rule, &sensor->trigger, n, t_ns, sensor->event_x, rule_scratch(sensor));
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
    const double *weight = sensor->rule.weight;
    double error = weight == NULL ? noack_norm(n, sensor->e_s)
                                  : image_norm(n, n, weight, sensor->e_s, rule_scratch(sensor));
    begin_row(output, NOACK_MESSAGES, &sensor->machine, message->sequence, message->t_ns, now_ns);
    put_reals(output, n, sensor->x);
    put_reals(output, n, x_s);
    put_reals(output, 1, &error);
    put_reals(output, 2, sides);
    put(output, event ? sensor->events : NOACK_NO_SEQUENCE);
    if (sensor->observer.kind != NOACK_NO_OBSERVER)
        put_reals(output, message->entries, message->vector);
    if (event) {
        begin_message(output, NOACK_UPDATE, sensor->events++, message->t_ns);
        append(output, n, sensor->x);
        if (sensor->reports_error) {
            int compares = sensor->is_user || sensor->rule.positive_rows > 0;
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
    if (sensor->acknowledged && sensor->sent_count == sensor->sent_places
        && !ask(machine, NOACK_ASK_ROOM))
        return NOACK_NOT_ANSWERED;
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
            noack_trigger_restart(
                &sensor->rule, &sensor->trigger, n, t_ns, x, rule_scratch(sensor));
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
    if (sensor->observer.kind == NOACK_NO_OBSERVER) {
        copy(machine->n, message->vector, sensor->x);
    } else {
        noack_observe(&sensor->observer, message, machine->n, machine->m, &sensor->plant_period);
        copy(machine->n, sensor->observer.x, sensor->x);
    }
    return handle_measurement(sensor, message, now_ns, output);
}
