/* Many runs of one loop, each from its last event to the next one: for searches among patterns of
   losses.

   The plant, the sensor and the controller of the loop make the steps of all runs. A run's state is
   loaded into them at its last event, and taken out at the next. At step k of the plant, in this
   order: x advances, y is measured, the trigger tests it; then updates arrive and the controller
   ticks, until step k + 1. Nothing is late, and every delivered update takes the same time. */
#include <math.h>

#include "channel.h"

static const double DIVERGED_NORM = 1e100; /* a state above this norm counts as diverged */
enum { LAST_STEP = 1 << 30 };

static int covers(const noack_signal *signal, int64_t last) {
    return signal->width == 0 || (signal->first == 0 && signal->rows > last);
}

const char *noack_segments_check(const noack_segments *segments) {
    const noack_plant *plant = segments->plant;
    const noack_machine *machine = &plant->machine;
    const noack_observer *observer = segments->sensor->observer;
    if (plant->system != NOACK_LINEAR || plant->predictions != 1 || plant->carries_model
        || segments->sensor->is_user || segments->sensor->acknowledged
        || segments->controller->is_user || segments->controller->acknowledges
        || segments->controller->timeout_ns <= MESSAGE_TIMES_NS)
        return "segments need a linear loop without acknowledgements, predictions and timeouts";
    if (segments->sensor->machine.n != machine->n || segments->controller->machine.n != machine->n
        || segments->controller->machine.m != machine->m)
        return "the machines of a loop have different sizes";
    if (!is_between(0, segments->last, LAST_STEP) || segments->delay_ns < 0 || segments->places < 1)
        return "the last step, the delay or the number of updates in flight is out of range";
    if (!covers(&plant->at_state, segments->last) || plant->at_input.width > 0
        || !covers(&plant->noise, segments->last / plant->measure_every))
        return "disturbances or noise end before the last step";
    if ((observer != NULL) != (segments->gains != NULL)
        || (observer != NULL && observer->kind == NOACK_KALMAN))
        return "an observer needs its gain at each measurement";
    return NULL;
}

/* The first tick of a machine that is not before a time. */
static int64_t first_tick(const noack_machine *machine, int64_t t_ns) {
    int64_t k = periods_within(&machine->period, max_of(t_ns - machine->first_ns, 0));
    while (k > 0 && time_of_tick_ns(machine, k - 1) >= t_ns)
        k--;
    while (time_of_tick_ns(machine, k) < t_ns)
        k++;
    return k;
}

/* Load the state of a run into the machines. */
static void load(noack_segments *segments, int64_t run) {
    noack_plant *plant = segments->plant;
    noack_sensor *sensor = segments->sensor;
    noack_controller *controller = segments->controller;
    int64_t n = plant->machine.n, m = plant->machine.m, step = segments->step[run];
    int64_t measure_every = plant->measure_every, first_step = max_of(step, 0);
    int64_t t_ns = time_of_tick_ns(&plant->machine, first_step);
    copy(n, segments->x + run * n, plant->x);
    copy(m, segments->u + run * m, plant->u);
    copy(m, segments->u_next + run * m, plant->inputs);
    if (plant->reports_inputs)
        memset(plant->recent_inputs, 0, (size_t)(measure_every * m) * sizeof *plant->recent_inputs);
    plant->newest_ns = t_ns;
    plant->machine.step = step + 1;
    plant->measurements = step < 0 ? 0 : step / measure_every + 1;
    noack_disturb(plant, first_step);
    copy(n, segments->x_s + run * n, sensor->x_s);
    copy(n, segments->y + run * n, sensor->x);
    sensor->model_ns = t_ns;
    sensor->has_state = 1;
    sensor->trigger.auxiliary = segments->auxiliary[run];
    noack_trigger_start(sensor->rule, &sensor->trigger, t_ns, sensor->x_s);
    if (segments->gains != NULL) {
        copy(n, segments->y + run * n, sensor->observer->x);
        sensor->observer->t_ns =
            step < 0 ? -1 : time_of_tick_ns(&plant->machine, step - step % measure_every);
        sensor->observer->corrections = step >= 0;
    }
    copy(n, segments->x_c + run * n, controller->x_c);
    controller->model_ns = t_ns;
    controller->machine.step = first_tick(&controller->machine, t_ns);
    /* The controller has a state from the update of the first step on. */
    controller->has_state = segments->known_start || segments->sent[run * segments->places] != 0.0;
}

/* x_c at a step. */
static void advance_controller(noack_segments *segments, int64_t step, double *x_c) {
    const noack_controller *controller = segments->controller;
    noack_model_advance(
        &controller->model, controller->x_c, controller->model_ns,
        time_of_tick_ns(&segments->plant->machine, step), x_c);
}

/* Take the state of a run out of the machines, at the end of a step and before its updates. */
static void store(noack_segments *segments, int64_t run, int64_t step) {
    const noack_plant *plant = segments->plant;
    const noack_sensor *sensor = segments->sensor;
    int64_t n = plant->machine.n, m = plant->machine.m;
    copy(n, plant->x, segments->x + run * n);
    copy(n, sensor->x, segments->y + run * n);
    copy(m, plant->u, segments->u + run * m);
    copy(m, plant->inputs, segments->u_next + run * m);
    noack_model_advance(
        &sensor->model, sensor->x_s, sensor->model_ns, time_of_tick_ns(&plant->machine, step),
        segments->x_s + run * n);
    advance_controller(segments, step, segments->x_c + run * n);
    segments->auxiliary[run] = sensor->trigger.auxiliary;
    segments->step[run] = step;
}

/* Let the updates arrive that arrive up to a time. */
static void receive(noack_segments *segments, int64_t run, int64_t until_ns, noack_output *output) {
    int64_t n = segments->plant->machine.n, places = segments->places;
    double *sent = segments->sent + run * places, *updates = segments->updates + run * places * n;
    noack_message message;
    while (sent[0] >= 0.0) {
        message.t_ns = time_of_tick_ns(&segments->plant->machine, (int64_t)sent[0]);
        if (message.t_ns + segments->delay_ns > until_ns)
            return;
        message.flow = NOACK_UPDATE;
        message.loop = message.sequence = 0; /* only the rows have them */
        message.entries = n;
        copy(n, updates, message.vector);
        noack_controller_handle(segments->controller, &message, until_ns, output);
        memmove(sent, sent + 1, (size_t)(places - 1) * sizeof *sent);
        memmove(updates, updates + n, (size_t)((places - 1) * n) * sizeof *updates);
        sent[places - 1] = -1.0;
    }
}

/* What the controller does between a step of the plant and the next one. */
static void control(noack_segments *segments, int64_t run, int64_t step, noack_output *output) {
    noack_controller *controller = segments->controller;
    const noack_machine *plant = &segments->plant->machine;
    int64_t next_ns = time_of_tick_ns(plant, step + 1), due_ns;
    receive(segments, run, time_of_tick_ns(plant, step), output);
    while ((due_ns = tick_ns(&controller->machine)) < next_ns) {
        receive(segments, run, due_ns, output);
        noack_controller_tick(controller, due_ns, output);
        noack_plant_handle(segments->plant, &output->message, due_ns, output);
    }
}

/* The user's trigger of a run without tests: there is no event. */
static int64_t answer_nothing(int64_t loop, int64_t question) {
    (void)loop;
    (void)question;
    return 0;
}

/* Let the sensor receive the measurement; return whether it is an event. */
static int64_t measure(
    noack_segments *segments, int64_t run, int64_t step, int64_t tests, noack_output *output) {
    noack_sensor *sensor = segments->sensor;
    int64_t n = sensor->machine.n, measurement = step / segments->plant->measure_every;
    double error[NOACK_MAX_ENTRIES], image[NOACK_MAX_ENTRIES];
    if (segments->gains != NULL)
        sensor->observer->gain =
            (double *)segments->gains + measurement * n * sensor->observer->p; /* not written */
    noack_message message;
    copy_message(&message, &output->message);
    int64_t (*ask)(int64_t, int64_t) = sensor->machine.ask;
    sensor->is_user = !tests;
    sensor->event = 0;
    sensor->machine.ask = answer_nothing;
    noack_sensor_handle(sensor, &message, message.t_ns, output);
    sensor->machine.ask = ask;
    sensor->is_user = 0;
    if (segments->controller->has_state) {
        advance_controller(segments, step, error);
        for (int64_t k = 0; k < n; k++)
            error[k] -= sensor->x[k];
        double size =
            image_norm(n, n, segments->weight, error, image) * segments->error_scale[step];
        if (size > segments->error[run]) {
            segments->error[run] = size;
            segments->error_at[run] = step;
        }
    }
    return output->sends;
}

static void follow_one(
    noack_segments *segments, int64_t run, int64_t last, int64_t tests, noack_output *output) {
    noack_plant *plant = segments->plant;
    int64_t n = plant->machine.n, step = segments->step[run];
    noack_note note;
    segments->is_event[run] = 0;
    segments->error[run] = segments->state[run] = segments->cost[run] = 0.0;
    load(segments, run);
    if (step >= 0)
        control(segments, run, step, output);
    while (step < last) {
        step++;
        double h_s = step > 0 ? (double)last_period_ns(&plant->machine) * 1e-9 : 0.0;
        noack_plant_tick(plant, time_of_tick_ns(&plant->machine, step), output, &note);
        double size = noack_norm(n, plant->x);
        if (!(size < DIVERGED_NORM)) {
            segments->error[run] = segments->state[run] = segments->cost[run] = INFINITY;
            break;
        }
        if (size * segments->state_scale[step] > segments->state[run]) {
            segments->state[run] = size * segments->state_scale[step];
            segments->state_at[run] = step;
        }
        segments->cost[run] += step > 0 ? size * size * h_s : 0.0;
        if (output->sends && measure(segments, run, step, tests, output)) {
            segments->is_event[run] = 1;
            break;
        }
        control(segments, run, step, output);
    }
    store(segments, run, step);
}

void noack_follow(noack_segments *segments, const int64_t *last, int64_t tests) {
    noack_output output;
    for (int64_t run = 0; run < segments->runs; run++)
        follow_one(segments, run, min_of(last[run], segments->last), tests, &output);
}
