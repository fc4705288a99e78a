/* The machines of one role: an input goes to the machine of its loop, its row into a table.

   Ticks are done in the order of their times, at equal times in the order of the loops. A loop
   begins at its phase, a time of the run; its messages, rows and notes have the loop's own time. */
#include "loop.h"

#include <math.h>

noack_machine *noack_process_machine(const noack_process *process, int64_t loop) {
    if (process->role == NOACK_PLANT)
        return &process->plants[loop].machine;
    if (process->role == NOACK_SENSOR)
        return &process->sensors[loop].machine;
    return &process->controllers[loop].machine;
}

static void push_tick(noack_process *process, int64_t loop) {
    const noack_machine *machine = noack_process_machine(process, loop);
    int64_t t_ns = tick_ns(machine);
    if (t_ns != NO_TICK)
        noack_heap_push(
            process->heap, &process->heap_count,
            (noack_heap_entry){t_ns + machine->phase_ns, loop, 0});
}

void noack_process_begin(noack_process *process) {
    process->heap_count = 0;
    for (int64_t loop = 0; loop < process->loops; loop++)
        push_tick(process, loop);
}

int64_t noack_process_due_ns(const noack_process *process) {
    return process->heap_count == 0 ? NO_TICK : process->heap[0].due_ns;
}

static int is_full(const noack_process *process, int64_t table) {
    return process->tables[table].count == process->tables[table].places
           || process->note_count == process->note_places;
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
    const int64_t *layout = table->layouts == NULL ? NULL : table->layouts[loop];
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
    if (process->role == NOACK_PLANT)
        return noack_plant_handle(&process->plants[loop], message, now_ns, output);
    if (process->role == NOACK_SENSOR)
        return noack_sensor_handle(&process->sensors[loop], message, now_ns, output);
    return noack_controller_handle(&process->controllers[loop], message, now_ns, output);
}

int64_t noack_do_tick(noack_process *process, int64_t loop, int64_t now_ns) {
    noack_output *output = &process->output;
    if (process->role == NOACK_CONTROLLER)
        return noack_controller_tick(&process->controllers[loop], now_ns, output);
    noack_note *note = &process->notes[process->note_count];
    return noack_plant_tick(&process->plants[loop], now_ns, output, note);
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
    }
    return keep_outputs(process, loop, question);
}
