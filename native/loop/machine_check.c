/* Checks the numbers of a process once, where they enter the core: all that the steps assume. */
#include <math.h>
#include <stddef.h>

#include "loop.h"

enum {
    MOST_PLACES = 1 << 20,
    MOST_EVERY = 1 << 20,
    MOST_ROWS = 1 << 16,
    MOST_PARTS = 100000,
    MOST_POWERS = 64,
    MOST_WAVES = 1 << 16
};
static const double MOST_HZ = 1e6;
static const int64_t MOST_LENGTH = INT64_C(1) << 32;

/* Times and numbers of which a few sums, with the time of a message, fit into an int64_t. */
static const int64_t MOST_NS = INT64_C(1) << 60, MOST_NUMBER = INT64_MAX / 2;

/* A time up to which a machine has come: that of a message at most. */
static int is_model_time(int64_t t_ns) { return is_between(0, t_ns, MESSAGE_TIMES_NS); }

/* Whether a period has at least some whole nanoseconds; its multiples do not overflow. */
static int is_period(const noack_period *period, int64_t least_ns) {
    return is_between(least_ns, period->ns, MOST_NS) && is_between(1, period->parts, MOST_PARTS)
           && is_between(0, period->part, period->parts - 1)
           && (period->part == 0 || period->parts <= period->ns);
}

static const char *check_machine(const noack_machine *machine) {
    if (!is_between(1, machine->n, NOACK_MAX_ENTRIES)
        || !is_between(1, machine->m, NOACK_MAX_ENTRIES))
        return "a machine needs 1 to 64 states and 1 to 64 inputs";
    if (machine->ask == NULL)
        return "a machine has nobody to ask";
    if (!is_between(0, machine->phase_ns, MOST_NS) || !is_between(0, machine->horizon_ns, MOST_NS)
        || !is_between(0, machine->first_ns, MOST_NS) || !is_period(&machine->period, 0))
        return "a machine has a phase, a horizon or a period out of range";
    if (!is_between(0, machine->step, MOST_NUMBER) || !is_between(0, machine->inputs, MOST_NUMBER)
        || (machine->period.ns > 0
            && machine->step > MOST_NS / max_of(machine->period.ns + 1, 2 * machine->period.parts)))
        return "a machine's step or count of inputs is out of range";
    if (!is_between(0, machine->received.entries, NOACK_MAX_ENTRIES)
        || machine->acknowledgements.entries != 0)
        return "a machine receives vectors of more than 64 entries";
    if (!is_between(0, machine->received.not_after_ns, MESSAGE_TIMES_NS - 1)
        || !is_between(0, machine->acknowledgements.not_after_ns, MESSAGE_TIMES_NS - 1))
        return "a machine receives messages of a time out of range";
    return NULL;
}

static const char *check_reference(const noack_reference *reference, int64_t n) {
    if (!is_between(0, reference->changes, MOST_LENGTH) || reference->is_zero == NULL
        || reference->rows == NULL || !is_between(n, reference->width, 2 * NOACK_MAX_ENTRIES)
        || !is_between(1, reference->powers, MOST_POWERS)
        || !is_between(0, reference->waves, MOST_WAVES)
        || (reference->waves > 0 && reference->hz == NULL)
        || (reference->changes > 0 && reference->since_ns == NULL))
        return "a model has no reference";
    for (int64_t k = 0; k < (reference->changes + 1) * reference->waves; k++)
        if (!(fabs(reference->hz[k]) <= MOST_HZ))
            return "a wave of a reference has a frequency out of range";
    int64_t since_ns = 0;
    for (int64_t k = 0; k < reference->changes; since_ns = reference->since_ns[k++])
        if (!is_between(since_ns, reference->since_ns[k], MESSAGE_TIMES_NS))
            return "the segments of a reference are not in the order of time";
    return NULL;
}

static const char *check_model(const noack_model *model, int64_t n) {
    const noack_transitions *transitions = model->transitions;
    if (transitions == NULL || transitions->n != n || transitions->H == NULL
        || transitions->steps_ns == NULL || transitions->matrices == NULL
        || transitions->scratch == NULL)
        return "a model has no matrices of its size";
    if (!is_between(4, transitions->places, MOST_PLACES)
        || (transitions->places & (transitions->places - 1)) != 0)
        return "the number of matrices that a model keeps must be a power of 2, at least 4";
    return check_reference(&model->reference, n);
}

static const char *check_signal(const noack_signal *signal, int64_t width) {
    if (signal->width == 0)
        return NULL;
    if (signal->width != width || !is_between(1, signal->rows, MOST_ROWS)
        || !is_between(-MOST_NUMBER, signal->first, MOST_NUMBER) || signal->values == NULL)
        return "a disturbance or noise does not have the width of the vector that it is added to";
    return NULL;
}

static const char *check_plant(const noack_plant *plant) {
    const noack_machine *machine = &plant->machine;
    int64_t n = machine->n, m = machine->m;
    if (machine->period.ns < 1 || !is_period(&plant->input_period, 1))
        return "a plant has no period";
    if (!is_between(1, plant->measure_every, MOST_EVERY)
        || !is_between(1, plant->p, NOACK_MAX_ENTRIES))
        return "a plant has no measurement";
    if (plant->C == NULL && plant->p != n)
        return "a plant without C measures all states";
    if (!is_between(NOACK_LINEAR, plant->system, NOACK_FAILED)
        || !is_between(NOACK_HOLD, plant->watchdog, NOACK_PREDICT))
        return "a plant has an unknown system or watchdog";
    if (plant->system == NOACK_LINEAR && (plant->Ad == NULL || plant->Bd == NULL))
        return "a linear plant has no matrices";
    if (!is_between(0, plant->internal, NOACK_MAX_ROW_WORDS - 6 - 4 * NOACK_MAX_ENTRIES))
        return "a plant's system has too many states of its own";
    const char *wrong;
    if ((wrong = check_signal(&plant->at_input, m)) != NULL
        || (wrong = check_signal(&plant->at_state, n)) != NULL
        || (wrong = check_signal(&plant->noise, plant->p)) != NULL)
        return wrong;
    if (plant->sources != m + plant->at_state.width)
        return "a plant's input matrix has another number of columns than it has sources";
    if (!is_between(1, plant->predictions, NOACK_MAX_ENTRIES)
        || machine->received.entries != plant->predictions * m + (plant->carries_model ? n : 0))
        return "a plant must receive actuations of its number of inputs";
    if (plant->p + (plant->reports_inputs ? plant->measure_every * m : 0) > NOACK_MAX_ENTRIES)
        return "a measurement has more than 64 entries";
    if (plant->timeout_ns < 0 || plant->notice_ns < 0 || !is_model_time(plant->newest_ns)
        || !is_model_time(plant->fallback_ns) || !is_between(0, plant->measurements, MOST_NUMBER))
        return "a plant has a timeout, a time or a number of measurements out of range";
    if (plant->x == NULL || plant->z == NULL || plant->u == NULL || plant->applied == NULL
        || plant->recent_inputs == NULL || plant->inputs == NULL || plant->scratch == NULL
        || (plant->carries_model && plant->x_c == NULL))
        return "a plant has no state";
    if (plant->watchdog != NOACK_PREDICT)
        return NULL;
    if (plant->K == NULL || plant->x_fallback == NULL || !plant->carries_model)
        return "a watchdog that predicts has no model";
    return check_model(&plant->fallback, n);
}

const char *noack_check_rule(const noack_trigger_rule *rule, int64_t most_ns) {
    const int64_t rows[] = {
        rule->positive_rows, rule->negative_rows, rule->positive_gain_rows,
        rule->negative_gain_rows};
    double *const matrices[] = {
        rule->positive, rule->negative, rule->positive_gain, rule->negative_gain};
    for (int k = 0; k < 4; k++)
        if (!is_between(0, rows[k], 4 * NOACK_MAX_ENTRIES) || (rows[k] > 0 && matrices[k] == NULL))
            return "a trigger rule has no matrix";
    if (!is_between(0, rule->since_ns, most_ns) || !is_between(0, rule->grid_ns, most_ns)
        || !is_between(-most_ns, rule->idle_ns, most_ns)
        || !is_between(0, rule->shortest_ns, most_ns) || !is_between(0, rule->longest_ns, most_ns))
        return "a trigger rule has times out of range";
    return NULL;
}

static const char *check_observer(const noack_observer *observer, const noack_machine *machine) {
    if (observer->kind == NOACK_NO_OBSERVER)
        return NULL;
    if (observer->kind != NOACK_LUENBERGER && observer->kind != NOACK_KALMAN)
        return "an observer is of an unknown kind";
    int64_t inputs = machine->received.entries - max_of(observer->p, 0);
    if (observer->p < 1 || inputs < machine->m || inputs % machine->m != 0)
        return "an observer receives measurements without the inputs applied";
    if (observer->Ad == NULL || observer->Bd == NULL || observer->C == NULL
        || observer->gain == NULL || observer->x == NULL || observer->scratch == NULL)
        return "an observer has no model";
    if (observer->t_ns != -1 && !is_model_time(observer->t_ns))
        return "an observer has a time out of range";
    if (observer->kind == NOACK_KALMAN
        && (observer->P == NULL || observer->Q == NULL || observer->R == NULL))
        return "a Kalman filter has no covariances";
    return NULL;
}

static const char *check_sensor(const noack_sensor *sensor) {
    const noack_machine *machine = &sensor->machine;
    const char *wrong;
    if ((wrong = check_model(&sensor->model, machine->n)) != NULL
        || (wrong = noack_check_rule(&sensor->rule, MOST_NS)) != NULL
        || (wrong = check_observer(&sensor->observer, machine)) != NULL)
        return wrong;
    if (machine->period.ns != 0)
        return "a sensor must not have ticks";
    if (sensor->observer.kind == NOACK_NO_OBSERVER ? machine->received.entries != machine->n
                                                   : !is_period(&sensor->plant_period, 1))
        return "a sensor receives measurements of the wrong size";
    if (sensor->x_s == NULL || sensor->event_x == NULL || sensor->x == NULL || sensor->e_s == NULL
        || sensor->scratch == NULL)
        return "a sensor has no state";
    if (!is_model_time(sensor->model_ns) || !is_model_time(sensor->trigger.since_ns)
        || !is_model_time(sensor->trigger.measured_ns)
        || !is_between(0, sensor->events, MOST_NUMBER))
        return "a sensor has a time or a number of events out of range";
    if (!sensor->acknowledged)
        return sensor->sent_count == 0 ? NULL : "a sensor waits for acknowledgements and has none";
    if (!is_between(0, sensor->sent_count, sensor->sent_places)
        || !is_between(1, sensor->sent_places, MOST_LENGTH) || sensor->sent == NULL
        || sensor->sent_x == NULL || !is_between(0, sensor->timeout_ns, MOST_NS))
        return "a sensor with acknowledgements has no room for updates";
    return NULL;
}

static const char *check_controller(const noack_controller *controller) {
    const noack_machine *machine = &controller->machine;
    int64_t n = machine->n, m = machine->m;
    if (machine->period.ns < 1 || machine->received.entries != n)
        return "a controller has no period, or receives updates of the wrong size";
    if (!is_between(1, controller->predictions, NOACK_MAX_ENTRIES)
        || controller->predictions * m + (controller->carries_model ? n : 0) > NOACK_MAX_ENTRIES)
        return "an actuation has more than 64 entries";
    if (controller->K == NULL || controller->safe_input == NULL || controller->x_c == NULL
        || controller->x == NULL || controller->u == NULL || controller->scratch == NULL)
        return "a controller has no state";
    if (!is_model_time(controller->model_ns) || !is_model_time(controller->update_ns)
        || controller->timeout_ns < 1
        || !is_between(NOACK_NO_SEQUENCE, controller->newest, INT64_MAX))
        return "a controller has a time or a newest update out of range";
    if (controller->model.reference.width < n + m)
        return "a controller has no input of its reference";
    return check_model(&controller->model, n);
}

/* The words of a row that a machine writes into a table; 0: it writes none. */
static int64_t row_words(const noack_process *process, int64_t loop, int64_t table) {
    const noack_machine *machine = noack_process_machine(process, loop);
    int64_t n = machine->n, m = machine->m;
    if (process->role == NOACK_SENSOR) {
        const noack_sensor *sensor = &process->sensors[loop];
        if (table == NOACK_ACKNOWLEDGEMENTS)
            return sensor->acknowledged ? 5 + 2 * n : 0;
        int64_t observed =
            sensor->observer.kind == NOACK_NO_OBSERVER ? 0 : machine->received.entries;
        return table == NOACK_MESSAGES ? 8 + 2 * n + observed : 0;
    }
    if (table == NOACK_ACKNOWLEDGEMENTS)
        return 0;
    if (process->role == NOACK_CONTROLLER)
        return table == NOACK_TICKS ? 5 + n + m : 6 + 3 * n;
    const noack_plant *plant = &process->plants[loop];
    if (table == NOACK_MESSAGES)
        return 4 + machine->received.entries;
    return 5 + n + m + (plant->predictions > 1) + plant->internal + plant->at_input.width
           + plant->at_state.width;
}

/* Whether the rows of a table have a place for each of their words. */
static int has_layout(const noack_table *table, int64_t loop, int64_t words) {
    int64_t bytes = table->row_bytes - NOACK_LOOP_BYTES;
    const int64_t *layout = table->layouts == NULL ? NULL : table->layouts[loop];
    if (layout == NULL)
        return bytes == 8 * words;
    if (bytes % 8 != 0 || !is_between(words, bytes / 8, NOACK_MAX_ROW_WORDS))
        return 0;
    for (int64_t k = 0; k < bytes / 8; k++)
        if (!is_between(NOACK_MISSING_ZERO, layout[k], words - 1))
            return 0;
    return 1;
}

static const char *check_tables(const noack_process *process, int64_t loop) {
    for (int64_t k = 0; k < NOACK_TABLES; k++) {
        const noack_table *table = &process->tables[k];
        int64_t words = row_words(process, loop, k);
        if (words == 0)
            continue;
        if (words > NOACK_MAX_ROW_WORDS || !has_layout(table, loop, words))
            return "the rows of a table do not have the size that the machines write";
        if (table->rows == NULL || !is_between(1, table->places, MOST_LENGTH)
            || !is_between(0, table->count, table->places))
            return "a table has no rows";
    }
    return NULL;
}

static const char *check_loop(const noack_process *process, int64_t loop) {
    const char *wrong = check_machine(noack_process_machine(process, loop));
    if (wrong != NULL)
        return wrong;
    if (process->role == NOACK_PLANT)
        wrong = check_plant(&process->plants[loop]);
    else if (process->role == NOACK_SENSOR)
        wrong = check_sensor(&process->sensors[loop]);
    else
        wrong = check_controller(&process->controllers[loop]);
    return wrong != NULL ? wrong : check_tables(process, loop);
}

const char *noack_process_check(const noack_process *process) {
    if (!is_between(NOACK_PLANT, process->role, NOACK_CONTROLLER)
        || !is_between(1, process->loops, MOST_LOOPS))
        return "a process has no role or no loops";
    if (process->heap == NULL || process->notes == NULL
        || !is_between(1, process->note_places, MOST_LENGTH)
        || !is_between(0, process->note_count, process->note_places)
        || (process->role == NOACK_PLANT && process->plants == NULL)
        || (process->role == NOACK_SENSOR && process->sensors == NULL)
        || (process->role == NOACK_CONTROLLER && process->controllers == NULL))
        return "a process has no machines";
    if (!is_between(0, process->heap_count, process->loops))
        return "a process has more loops with a tick than it has loops";
    for (int64_t loop = 0; loop < process->loops; loop++) {
        const char *wrong = check_loop(process, loop);
        if (wrong != NULL)
            return wrong;
    }
    return NULL;
}
