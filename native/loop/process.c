/* The machines of one role: an input goes to the machine of its loop, its row into a table.

   Ticks are done in the order of their times, at equal times in the order of the loops. A loop
   begins at its phase, a time of the run; its messages, rows and notes have the loop's own time. */
#include "loop.h"

#include <math.h>
#include <stdlib.h>

enum { FETCHED_BYTES = 896 }; /* of a machine: more than a plant of two states has */

/* Which word of a loop's own row each word of a row of the table is; NULL: they are the same. */
static const int64_t *layout_of(const noack_table *table, int64_t loop) {
    int64_t words = (table->row_bytes - NOACK_LOOP_BYTES) / 8;
    return table->layouts == NULL ? NULL : table->layouts + table->kind_of[loop] * words;
}

noack_machine *noack_process_machine(const noack_process *process, int64_t loop) {
    return process->machines[loop];
}

void fetch_machine(const noack_process *process, int64_t loop) {
    if (loop >= process->loops)
        return;
    const uint8_t *memory = (const uint8_t *)process->machines[loop];
    for (int offset = 0; offset < FETCHED_BYTES; offset += LINE_BYTES)
        __builtin_prefetch(memory + offset);
}

static void push_tick(noack_process *process, int64_t loop) {
    const noack_machine *machine = noack_process_machine(process, loop);
    int64_t t_ns = tick_ns(machine);
    if (t_ns != NO_TICK)
        noack_heap_push(
            process->heap, &process->heap_count,
            (noack_heap_entry){t_ns + machine->phase_ns, loop, 0});
}

int64_t noack_process_due_ns(const noack_process *process) {
    return process->heap_count == 0 ? NO_TICK : process->heap[0].due_ns;
}

static int is_full(const noack_process *process, int64_t table) {
    return process->tables[table].count == process->tables[table].places
           || process->note_count == NOACK_NOTES;
}

/* Write a loop's own row where the columns of a table with longer vectors have it. */
static void spread_row(
    const int64_t *layout, int64_t words, const int64_t *loop_row, uint8_t *row) {
    static const double missing = NAN;
    for (int64_t k = 0; k < words; k++, row += sizeof *loop_row) {
        if (layout[k] >= 0)
            memcpy(row, &loop_row[layout[k]], sizeof *loop_row);
        else if (layout[k] == NOACK_MISSING_NAN)
            memcpy(row, &missing, sizeof missing);
        else
            memset(row, 0, sizeof *loop_row);
    }
}

/* Append the row of the output to its table, behind the number of the loop. */
static void append_row(noack_process *process, int64_t loop) {
    noack_table *table = &process->tables[process->output.table];
    uint8_t *row = table->rows + table->count++ * table->row_bytes;
    int64_t bytes = table->row_bytes - NOACK_LOOP_BYTES;
    const int64_t *layout = layout_of(table, loop);
    uint16_t loop_number = (uint16_t)loop;
    memcpy(row, &loop_number, NOACK_LOOP_BYTES);
    if (layout == NULL)
        memcpy(row + NOACK_LOOP_BYTES, process->output.row, (size_t)bytes);
    else
        spread_row(layout, bytes / 8, process->output.row, row + NOACK_LOOP_BYTES);
}

/* Keep the outputs of a step that is done. */
static int64_t keep_outputs(noack_process *process, int64_t loop, int64_t question) {
    if (question != NOACK_DONE)
        return question;
    append_row(process, loop);
    process->output.message.loop = loop;
    if (process->output.notes)
        process->notes[process->note_count++].loop = loop;
    return NOACK_DONE;
}

int64_t noack_handle_message(
    noack_process *process, int64_t loop, const noack_message *message, int64_t now_ns) {
    noack_output *output = &process->output;
    noack_machine *machine = process->machines[loop];
    if (process->role == NOACK_PLANT)
        return noack_plant_handle((noack_plant *)machine, message, now_ns, output);
    if (process->role == NOACK_SENSOR)
        return noack_sensor_handle((noack_sensor *)machine, message, now_ns, output);
    return noack_controller_handle((noack_controller *)machine, message, now_ns, output);
}

int64_t noack_do_tick(noack_process *process, int64_t loop, int64_t now_ns) {
    noack_output *output = &process->output;
    noack_machine *machine = process->machines[loop];
    if (process->role == NOACK_CONTROLLER)
        return noack_controller_tick((noack_controller *)machine, now_ns, output);
    noack_note *note = &process->notes[process->note_count];
    return noack_plant_tick((noack_plant *)machine, now_ns, output, note);
}

int64_t noack_process_handle(noack_process *process, const noack_message *message, int64_t now_ns) {
    int64_t loop = message->loop, acknowledges = message->flow == NOACK_ACKNOWLEDGEMENT;
    if (is_full(process, acknowledges ? NOACK_ACKNOWLEDGEMENTS : NOACK_MESSAGES))
        return NOACK_ROWS_FULL;
    now_ns -= noack_process_machine(process, loop)->phase_ns;
    return keep_outputs(process, loop, noack_handle_message(process, loop, message, now_ns));
}

int64_t noack_process_tick(noack_process *process, int64_t now_ns) {
    if (is_full(process, NOACK_TICKS))
        return NOACK_ROWS_FULL;
    int64_t loop = process->heap[0].number;
    now_ns -= noack_process_machine(process, loop)->phase_ns;
    int64_t question = noack_do_tick(process, loop, now_ns);
    if (question == NOACK_DONE) {
        noack_heap_pop(process->heap, &process->heap_count);
        push_tick(process, loop);
        if (process->heap_count > 0)
            fetch_machine(process, process->heap[0].number);
    }
    return keep_outputs(process, loop, question);
}

/* How it is made. ------------------------------------------------------------------------------ */

static const int64_t MOST_PLACES = INT64_C(1) << 32;

const char *begin_machine(noack_machine *machine, int64_t flow) {
    if (!is_between(1, machine->n, NOACK_MAX_ENTRIES)
        || !is_between(1, machine->m, NOACK_MAX_ENTRIES))
        return "a machine needs 1 to 64 states and 1 to 64 inputs";
    if (!is_between(0, machine->phase_ns, MOST_NS) || !is_between(0, machine->horizon_ns, MOST_NS)
        || !is_between(0, machine->first_ns, MOST_NS) || !is_period(&machine->period, 0))
        return "a machine has a phase, a horizon or a period out of range";
    machine->step = machine->inputs = machine->loop = 0;
    machine->reached_ns = -1;
    machine->change_ns = INT64_MAX;
    machine->ask = NULL;
    noack_reception reception = {.newest = -1, .not_after_ns = machine->horizon_ns};
    machine->received = machine->acknowledgements = reception;
    machine->received.flow = flow;
    machine->acknowledgements.flow = NOACK_ACKNOWLEDGEMENT;
    return NULL;
}

/* The words of a row that a machine writes into a table; 0: it writes none. */
static int64_t row_words(int64_t role, const noack_machine *machine, int64_t table) {
    int64_t n = machine->n, m = machine->m;
    if (role == NOACK_SENSOR) {
        const noack_sensor *sensor = (const noack_sensor *)machine;
        if (table == NOACK_ACKNOWLEDGEMENTS)
            return sensor->acknowledged ? 5 + 2 * n : 0;
        int64_t observed = sensor->observer == NULL ? 0 : machine->received.entries;
        return table == NOACK_MESSAGES ? 8 + 2 * n + observed : 0;
    }
    if (table == NOACK_ACKNOWLEDGEMENTS)
        return 0;
    if (role == NOACK_CONTROLLER)
        return table == NOACK_TICKS ? 5 + n + m : 6 + 3 * n;
    const noack_plant *plant = (const noack_plant *)machine;
    if (table == NOACK_MESSAGES)
        return 4 + machine->received.entries;
    return 5 + n + m + (plant->predictions > 1) + plant->internal + plant->at_input.width
           + plant->at_state.width;
}

/* Whether the rows of a table have a place for each word of a loop's own row. */
static int has_layout(const noack_table *table, int64_t loop, int64_t words) {
    int64_t bytes = table->row_bytes - NOACK_LOOP_BYTES;
    if (table->layouts == NULL)
        return bytes == 8 * words;
    if (bytes < 8 * words || !is_between(0, table->kind_of[loop], table->kinds - 1))
        return 0;
    for (int64_t k = 0; k < bytes / 8; k++)
        if (!is_between(NOACK_MISSING_ZERO, layout_of(table, loop)[k], words - 1))
            return 0;
    return 1;
}

static const char *check_table(const noack_process *process, int64_t number) {
    const noack_table *table = &process->tables[number];
    int64_t bytes = table->row_bytes - NOACK_LOOP_BYTES;
    int is_table = table->rows != NULL && is_between(1, table->places, MOST_PLACES)
                   && is_between(8, bytes, 8 * NOACK_MAX_ROW_WORDS) && bytes % 8 == 0
                   && (table->layouts == NULL || table->kind_of != NULL);
    for (int64_t loop = 0; loop < process->loops; loop++) {
        int64_t words = row_words(process->role, process->machines[loop], number);
        if (words > 0 && (!is_table || !has_layout(table, loop, words)))
            return "the rows of a table do not have the size that the machines write";
    }
    return NULL;
}

/* Copy the layouts of a table, whose rows are the caller's; return 0 if there is no memory. */
static int take_layouts(noack_table *table, int64_t loops) {
    int64_t words = table->kinds * (table->row_bytes - NOACK_LOOP_BYTES) / 8;
    table->count = 0;
    if (table->layouts == NULL)
        return 1;
    table->layouts = copy_of(table->layouts, words, sizeof *table->layouts);
    table->kind_of = copy_of(table->kind_of, loops, sizeof *table->kind_of);
    return table->layouts != NULL && table->kind_of != NULL;
}

noack_process *noack_process_new(
    int64_t role, int64_t loops, noack_machine *const *machines,
    int64_t (*ask)(int64_t loop, int64_t question), const noack_table *tables, const char **wrong) {
    noack_process given = {.role = role, .loops = loops, .machines = (noack_machine **)machines};
    memcpy(given.tables, tables, sizeof given.tables);
    *wrong = NULL;
    if (!is_between(NOACK_PLANT, role, NOACK_CONTROLLER) || !is_between(1, loops, MOST_LOOPS)
        || ask == NULL)
        *wrong = "a process has no role, no loops or nobody to ask";
    for (int64_t number = 0; *wrong == NULL && number < NOACK_TABLES; number++)
        *wrong = check_table(&given, number);
    noack_process *process = *wrong == NULL ? copy_of(&given, 1, sizeof given) : NULL;
    if (process == NULL)
        return NULL;
    process->machines = copy_of(machines, loops, sizeof *machines);
    process->heap = zeros(loops, sizeof *process->heap);
    process->notes = zeros(NOACK_NOTES, sizeof *process->notes);
    int complete = process->machines != NULL && process->heap != NULL && process->notes != NULL;
    for (int64_t number = 0; number < NOACK_TABLES; number++)
        complete &= take_layouts(&process->tables[number], loops);
    if (!complete) {
        noack_process_free(process);
        return NULL;
    }
    for (int64_t loop = 0; loop < loops; loop++) {
        machines[loop]->loop = loop;
        machines[loop]->ask = ask;
        push_tick(process, loop);
    }
    return process;
}

void noack_process_free(noack_process *process) {
    for (int64_t number = 0; number < NOACK_TABLES; number++) {
        free(process->tables[number].layouts);
        free(process->tables[number].kind_of);
    }
    free(process->machines);
    free(process->heap);
    free(process->notes);
    free(process);
}
