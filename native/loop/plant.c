/* The plant: a system on a time grid, under held inputs.

   At grid time t_k = k h the plant advances its system to t_k under the input held since t_(k-1).
   Then it measures, and latches the newest actuation received; the input that is due of it is held
   until t_(k+1). A late step has the same length h, and the plant catches up. If h is no whole
   number of nanoseconds, t_k is rounded, and steps differ by 1 ns.

   An actuation for the model time t carries N inputs, for t, t + h_c, ..., t + (N - 1) h_c, where
   h_c is the period of the controller. Input j is applied from t + j h_c on, the last one until a
   newer actuation arrives, or until the watchdog chooses the input: the newest actuation is too old
   if t_k - t > timeout. Before the first actuation its time is 0. */
#include <stdlib.h>

#include "loop.h"

static int has(const noack_signal *signal, int64_t step) {
    return signal->width == 0 || (signal->first <= step && step < signal->first + signal->rows);
}

static const double *value(const noack_signal *signal, int64_t step) {
    return signal->values + (step - signal->first) * signal->width;
}

int64_t noack_plant_handle(
    noack_plant *plant, const noack_message *message, int64_t now_ns, noack_output *output) {
    noack_machine *machine = &plant->machine;
    int64_t m = machine->m, inputs = plant->predictions * m;
    copy(inputs, message->vector, plant->inputs);
    plant->newest_ns = message->t_ns;
    plant->newest_sequence = message->sequence;
    begin_row(output, NOACK_MESSAGES, machine, message->sequence, message->t_ns, now_ns);
    put_reals(output, inputs, plant->inputs);
    if (plant->carries_model) {
        copy(machine->n, message->vector + inputs, plant->x_c);
        put_reals(output, machine->n, plant->x_c);
    }
    return NOACK_DONE;
}

/* Append the input of the last period, which the next measurement reports. */
static void append_recent_input(noack_plant *plant) {
    int64_t m = plant->machine.m, kept = (plant->measure_every - 1) * m;
    memmove(
        plant->recent_inputs, plant->recent_inputs + m,
        (size_t)kept * sizeof *plant->recent_inputs);
    copy(m, plant->u, plant->recent_inputs + kept);
}

/* Advance the system over a period under the input held. */
static void advance(noack_plant *plant) {
    int64_t n = plant->machine.n;
    if (plant->reports_inputs)
        append_recent_input(plant);
    if (plant->system != NOACK_LINEAR)
        return;
    int64_t longer = last_period_ns(&plant->machine) - plant->machine.period.ns; /* 0 or 1 */
    double *free_part = plant->scratch, *forced_part = free_part + n;
    noack_product(n, n, plant->Ad + longer * n * n, plant->x, free_part);
    noack_product(
        n, plant->sources, plant->Bd + longer * n * plant->sources, plant->applied, forced_part);
    for (int64_t k = 0; k < n; k++)
        plant->x[k] = free_part[k] + forced_part[k];
}

/* A predictive actuator: u + K(e^(H(t - t_j)) x_c - x_c), the controller's input if no update has
   arrived since the actuation of time t_j. Each call advances the state over one step. */
static void predict(noack_plant *plant, int64_t t_ns) {
    int64_t n = plant->machine.n, m = plant->machine.m;
    copy(m, plant->inputs, plant->u);
    if (plant->newest_sequence == NOACK_NO_SEQUENCE)
        return;
    if (plant->newest_sequence != plant->fallback_sequence) {
        plant->fallback_sequence = plant->newest_sequence;
        plant->fallback_ns = plant->newest_ns;
        copy(n, plant->x_c, plant->x_fallback);
    }
    noack_model_advance(
        &plant->fallback, plant->x_fallback, plant->fallback_ns, t_ns, plant->x_fallback);
    plant->fallback_ns = t_ns;
    double *input_now = plant->scratch, *input_then = input_now + m;
    noack_product(m, n, plant->K, plant->x_fallback, input_now);
    noack_product(m, n, plant->K, plant->x_c, input_then);
    for (int64_t k = 0; k < m; k++)
        plant->u[k] = plant->inputs[k] + (input_now[k] - input_then[k]);
}

/* Choose the input from t_ns on; return its number in the newest actuation, -1: the watchdog's. */
static int64_t choose_input(noack_plant *plant, int64_t t_ns) {
    int64_t m = plant->machine.m, last = plant->predictions - 1;
    if (t_ns - plant->newest_ns <= plant->timeout_ns) {
        int64_t age_ns = max_of(t_ns - plant->newest_ns, 0);
        int64_t entry = min_of(periods_within(&plant->input_period, age_ns), last);
        copy(m, plant->inputs + entry * m, plant->u);
        return entry;
    }
    if (plant->watchdog == NOACK_HOLD)
        copy(m, plant->inputs + last * m, plant->u);
    else if (plant->watchdog == NOACK_ZERO)
        memset(plant->u, 0, (size_t)m * sizeof *plant->u);
    else
        predict(plant, t_ns);
    return -1;
}

/* Note that actuations are missing, or that they arrive again. */
static int64_t notice(noack_plant *plant, int64_t t_ns, noack_note *note) {
    int is_missing = t_ns - plant->newest_ns > plant->notice_ns;
    if (is_missing == (plant->missing_ns >= 0))
        return 0;
    note->t_ns = t_ns;
    note->since_ns = plant->missing_ns;
    note->newest_ns = plant->newest_ns;
    note->newest_sequence = plant->newest_sequence;
    plant->missing_ns = is_missing ? t_ns : -1;
    return 1;
}

void noack_disturb(noack_plant *plant, int64_t step) {
    int64_t m = plant->machine.m;
    copy(m, plant->u, plant->applied);
    if (plant->at_input.width > 0) {
        const double *d = value(&plant->at_input, step);
        for (int64_t k = 0; k < m; k++)
            plant->applied[k] += d[k];
    }
    if (plant->at_state.width > 0)
        copy(plant->machine.n, value(&plant->at_state, step), plant->applied + m);
}

/* y = C x + v, and the inputs since the last measurement if they are reported. */
static void measure(noack_plant *plant, int64_t t_ns, noack_output *output) {
    int64_t sequence = plant->measurements++;
    begin_message(output, NOACK_MEASUREMENT, sequence, t_ns);
    double *y = output->message.vector;
    if (plant->C == NULL)
        copy(plant->p, plant->x, y);
    else
        noack_product(plant->p, plant->machine.n, plant->C, plant->x, y);
    output->message.entries = plant->p;
    if (plant->noise.width > 0) {
        const double *v = value(&plant->noise, sequence);
        for (int64_t k = 0; k < plant->p; k++)
            y[k] += v[k];
    }
    if (plant->reports_inputs)
        append(output, plant->measure_every * plant->machine.m, plant->recent_inputs);
}

static void put_step(
    noack_plant *plant, int64_t step, int64_t t_ns, int64_t now_ns, int64_t entry,
    noack_output *output) {
    noack_machine *machine = &plant->machine;
    begin_row(output, NOACK_TICKS, machine, step, t_ns, now_ns);
    put_reals(output, machine->n, plant->x);
    put_reals(output, machine->m, plant->u);
    put(output, plant->newest_sequence);
    if (plant->predictions > 1)
        put(output, entry);
    put_reals(output, plant->internal, plant->z);
    if (plant->at_input.width > 0)
        put_reals(output, plant->at_input.width, value(&plant->at_input, step));
    if (plant->at_state.width > 0)
        put_reals(output, plant->at_state.width, value(&plant->at_state, step));
}

int64_t noack_plant_tick(
    noack_plant *plant, int64_t now_ns, noack_output *output, noack_note *note) {
    noack_machine *machine = &plant->machine;
    int64_t step = machine->step, t_ns = time_of_tick_ns(machine, step);
    int measures = step % plant->measure_every == 0;
    int has_signals = has(&plant->at_input, step) && has(&plant->at_state, step)
                      && (!measures || has(&plant->noise, plant->measurements));
    if (!has_signals && !ask(machine, NOACK_ASK_SIGNALS))
        return NOACK_NOT_ANSWERED;
    if (step > 0 && plant->system == NOACK_USER && !ask(machine, NOACK_ASK_STATE))
        return NOACK_NOT_ANSWERED;
    if (step > 0)
        advance(plant);
    int64_t entry = choose_input(plant, t_ns);
    noack_disturb(plant, step);
    put_step(plant, step, t_ns, now_ns, entry, output);
    output->notes = notice(plant, t_ns, note);
    machine->step++;
    if (measures)
        measure(plant, t_ns, output);
    return NOACK_DONE;
}

/* How it is made. ------------------------------------------------------------------------------ */

static const char *check_signal(const noack_signal *signal, int64_t width) {
    if (signal->width != 0
        && (signal->width != width || !is_between(1, signal->rows, MOST_ROWS)
            || !is_between(-MOST_NUMBER, signal->first, MOST_NUMBER)))
        return "a disturbance or noise does not have the width of the vector that it is added to";
    return NULL;
}

/* Check the numbers of a new plant, and complete them. */
static const char *check(noack_plant *plant) {
    noack_machine *machine = &plant->machine;
    const char *wrong = begin_machine(machine, NOACK_ACTUATION);
    if (wrong != NULL)
        return wrong;
    int64_t n = machine->n, m = machine->m;
    if (machine->period.ns < 1 || !is_period(&plant->input_period, 1))
        return "a plant has no period";
    if (plant->C == NULL)
        plant->p = n;
    if (!is_between(1, plant->measure_every, MOST_EVERY)
        || !is_between(1, plant->p, NOACK_MAX_ENTRIES))
        return "a plant has no measurement";
    if (!is_between(NOACK_LINEAR, plant->system, NOACK_FAILED)
        || !is_between(NOACK_HOLD, plant->watchdog, NOACK_PREDICT))
        return "a plant has an unknown system or watchdog";
    if (!is_between(0, plant->internal, NOACK_MAX_ROW_WORDS - 6 - 4 * NOACK_MAX_ENTRIES))
        return "a plant's system has too many states of its own";
    if ((wrong = check_signal(&plant->at_input, m)) != NULL
        || (wrong = check_signal(&plant->at_state, n)) != NULL
        || (wrong = check_signal(&plant->noise, plant->p)) != NULL)
        return wrong;
    if (!is_between(1, plant->predictions, NOACK_MAX_ENTRIES)
        || plant->predictions * m + (plant->carries_model ? n : 0) > NOACK_MAX_ENTRIES)
        return "an actuation has more than 64 entries";
    if (plant->p + (plant->reports_inputs ? plant->measure_every * m : 0) > NOACK_MAX_ENTRIES)
        return "a measurement has more than 64 entries";
    if (plant->timeout_ns < 0 || plant->notice_ns < 0)
        return "a plant has a timeout below 0";
    if (plant->watchdog == NOACK_PREDICT
        && (!plant->carries_model || !is_model(&plant->fallback, n, n)))
        return "a watchdog that predicts has no model";
    machine->received.entries = plant->predictions * m + (plant->carries_model ? n : 0);
    plant->sources = m + plant->at_state.width;
    plant->measurements = plant->newest_ns = plant->fallback_ns = 0;
    plant->newest_sequence = plant->fallback_sequence = NOACK_NO_SEQUENCE;
    plant->missing_ns = -1;
    return NULL;
}

noack_plant *noack_plant_new(const noack_plant *settings, const char **wrong) {
    noack_plant plant = *settings;
    if ((*wrong = check(&plant)) != NULL)
        return NULL;
    int64_t n = plant.machine.n, m = plant.machine.m, sources = plant.sources;
    int64_t lengths = plant.machine.period.part > 0 ? 2 : 1;
    int64_t reported = plant.reports_inputs ? plant.measure_every * m : 0;
    int of_linear = plant.system == NOACK_LINEAR ? NEEDED : OPTIONAL;
    owned_array arrays[] = {
        {&plant.Ad, lengths * n * n, of_linear},
        {&plant.Bd, lengths * n * sources, of_linear},
        {&plant.C, plant.p * n, OPTIONAL},
        {&plant.K, m * n, plant.watchdog == NOACK_PREDICT ? NEEDED : OPTIONAL},
        {&plant.at_input.values, plant.at_input.rows * plant.at_input.width, STATE},
        {&plant.at_state.values, plant.at_state.rows * plant.at_state.width, STATE},
        {&plant.noise.values, plant.noise.rows * plant.noise.width, STATE},
        {&plant.x, n, STATE},
        {&plant.z, plant.internal, STATE},
        {&plant.u, m, STATE},
        {&plant.applied, sources, STATE},
        {&plant.recent_inputs, reported, STATE},
        {&plant.inputs, plant.predictions * m, STATE},
        {&plant.x_c, n, STATE},
        {&plant.x_fallback, n, STATE},
        {&plant.scratch, 2 * n + 2 * m, STATE},
    };
    return with_arrays(
        &plant, sizeof plant, arrays, sizeof arrays / sizeof *arrays,
        "a plant lacks the matrices of its system or its watchdog", wrong);
}

void noack_plant_free(noack_plant *plant) { free(plant); }
