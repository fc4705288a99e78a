/* Replay: a machine, or the network, receives its recorded inputs, and each row that it writes is
   compared with the recorded one, bit for bit.

   No output depends on the exact value of now_ns. So it is only checked that it is not before a
   deadline, and does not decrease. After a difference the replay goes on: what the machine sends is
   compared with what its receivers recorded. */
#include "channel.h"

enum { TABLES = 4, SEQUENCE = 8, TIME = 16, NOW = 24, SENT_HEADER = 3, SENT_DATAGRAM = 5 };
enum { PACKET_FLOW = 32, PACKET_SIZE = 80, PACKET_HEAD = 88, MOST_BYTES = 65535 };
static const int64_t EARLIEST_NS = -3600 * NS_PER_S; /* by a clock that is off */

static const noack_reception *reception_of(const noack_input_replay *replay, int64_t kind) {
    const noack_machine *machine = noack_process_machine(replay->process, replay->loop);
    return kind == NOACK_ACKNOWLEDGEMENTS ? &machine->acknowledgements : &machine->received;
}

static const char *check_table(
    const noack_input_replay *replay, const noack_recorded_table *table) {
    if (!is_between(NOACK_TICKS, table->kind, NOACK_SETTINGS) || table->count < 0)
        return "a recorded table has an unknown kind, or a negative length";
    if (table->kind == NOACK_SETTINGS || table->count == 0)
        return NULL;
    if (!is_between(NOW + 8, table->row_bytes, (int64_t)sizeof replay->replayed))
        return "the rows of a recorded table are too short or too long";
    int is_network = replay->role == NOACK_NETWORK;
    if (is_network && table->kind == NOACK_MESSAGES && table->row_bytes != sizeof(noack_packet_row))
        return "a row of a packet has the wrong size";
    if (is_network || table->kind == NOACK_TICKS)
        return NULL;
    int64_t entries = 0;
    for (int i = 0; i < 3; i++) {
        const noack_columns *columns = &table->vector[i];
        if (!is_between(0, columns->entries, NOACK_MAX_ENTRIES)
            || !is_between(0, columns->begin, table->row_bytes - 8 * columns->entries))
            return "the vector of a message lies outside its row";
        entries += columns->entries;
    }
    if (entries != reception_of(replay, table->kind)->entries)
        return "a recorded message does not have the size that the machine receives";
    return NULL;
}

const char *noack_replay_check(const noack_input_replay *replay) {
    int is_network = replay->role == NOACK_NETWORK;
    if (is_network ? replay->channel == NULL
                   : replay->process == NULL || replay->process->role != replay->role
                         || !is_between(0, replay->loop, replay->process->loops - 1))
        return "a replay has no machine";
    if (!is_between(0, replay->next, replay->count))
        return "a replay has used more inputs than it has";
    if (is_network ? replay->sent_width != SENT_DATAGRAM : replay->sent_width <= SENT_HEADER)
        return "there is no room for the messages that are sent";
    const char *wrong = NULL;
    int64_t rows = 0;
    for (int i = 0; wrong == NULL && i < TABLES; i++) {
        wrong = check_table(replay, &replay->tables[i]);
        rows += replay->tables[i].count;
    }
    for (int64_t i = 0; wrong == NULL && i < replay->count; i++)
        if (!is_between(0, replay->order[i], rows - 1))
            return "an input is in no table";
    return wrong;
}

static int64_t word_at(const uint8_t *row, int64_t begin) {
    int64_t word;
    memcpy(&word, row + begin, sizeof word);
    return word;
}

/* Note the first difference. */
static void differ(noack_input_replay *replay, int64_t difference, int64_t other_ns) {
    if (replay->difference != NOACK_EQUAL)
        return;
    replay->difference = difference;
    replay->difference_at = replay->next;
    replay->other_ns = other_ns;
}

/* Compare a row that was written with the recorded one. */
static void compare(
    noack_input_replay *replay, const noack_recorded_table *table, const uint8_t *recorded,
    int64_t kind, int64_t row_bytes, const void *row) {
    if (kind != table->kind || row_bytes != table->row_bytes) {
        differ(replay, NOACK_OTHER_TABLE, INT64_MAX);
    } else if (memcmp(recorded, row, (size_t)row_bytes) != 0 && replay->difference == NOACK_EQUAL) {
        differ(replay, NOACK_ROW_DIFFERS, INT64_MAX);
        memcpy(replay->replayed, row, (size_t)row_bytes);
    }
}

/* Check the time of a tick, or of a departure. */
static void check_deadline(noack_input_replay *replay, int64_t due_ns, int64_t now_ns) {
    if (due_ns == INT64_MAX || now_ns < due_ns)
        differ(replay, NOACK_BEFORE_DEADLINE, due_ns);
}

/* The network. --------------------------------------------------------------------------------- */

static int64_t replay_packet(noack_input_replay *replay, const uint8_t *recorded, int64_t now_ns) {
    noack_channel *channel = replay->channel;
    noack_datagram datagram = {
        .flow = word_at(recorded, PACKET_FLOW),
        .size_bytes = min_of(max_of(word_at(recorded, PACKET_SIZE), 0), MOST_BYTES),
        .arrival_ns = word_at(recorded, TIME),
        .bit = -1,
    };
    memcpy(datagram.head, recorded + PACKET_HEAD, NOACK_HEAD_BYTES);
    if (!is_between(EARLIEST_NS, now_ns, LATEST_NS)
        || !is_between(0, datagram.flow, channel->directions * channel->loops - 1))
        return NOACK_CANNOT_TAKE;
    return noack_channel_handle(channel, &datagram, now_ns);
}

static int64_t replay_network(
    noack_input_replay *replay, const noack_recorded_table *table, const uint8_t *recorded,
    int64_t now_ns) {
    noack_channel *channel = replay->channel;
    int64_t question, releases = table->kind == NOACK_TICKS;
    if (releases) {
        check_deadline(replay, noack_channel_due_ns(channel), now_ns);
        question =
            channel->heap_count > 0 ? noack_channel_release(channel, now_ns) : NOACK_CANNOT_TAKE;
    } else {
        question = replay_packet(replay, recorded, now_ns);
    }
    if (question != NOACK_DONE)
        return question;
    if (releases)
        compare(
            replay, table, recorded, NOACK_TICKS, sizeof(noack_release_row),
            &channel->releases[--channel->release_count]);
    else
        compare(
            replay, table, recorded, NOACK_MESSAGES, sizeof(noack_packet_row),
            &channel->packets[--channel->packet_count]);
    for (int64_t i = 0; i < channel->leaving_count; i++) {
        int64_t *sent = replay->sent + replay->sent_count++ * SENT_DATAGRAM;
        sent[0] = channel->leaving[i].flow;
        memcpy(sent + 1, channel->leaving[i].head, NOACK_HEAD_BYTES);
    }
    return NOACK_DONE;
}

/* The machines. -------------------------------------------------------------------------------- */

static int64_t tick(noack_input_replay *replay, int64_t now_ns) {
    noack_process *process = replay->process;
    int64_t due_ns = tick_ns(noack_process_machine(process, replay->loop));
    check_deadline(replay, due_ns, now_ns);
    if (due_ns == NO_TICK || process->role == NOACK_SENSOR)
        return NOACK_CANNOT_TAKE;
    return noack_do_tick(process, replay->loop, now_ns);
}

static int64_t handle(
    noack_input_replay *replay, const noack_recorded_table *table, const uint8_t *recorded,
    int64_t now_ns) {
    static const int64_t receives[] = {
        [NOACK_PLANT] = NOACK_ACTUATION,
        [NOACK_SENSOR] = NOACK_MEASUREMENT,
        [NOACK_CONTROLLER] = NOACK_UPDATE,
    };
    noack_process *process = replay->process;
    noack_message message = {
        .flow =
            table->kind == NOACK_ACKNOWLEDGEMENTS ? NOACK_ACKNOWLEDGEMENT : receives[process->role],
        .loop = replay->loop,
        .sequence = word_at(recorded, SEQUENCE),
        .t_ns = word_at(recorded, TIME),
    };
    int64_t latest_ns = reception_of(replay, table->kind)->not_after_ns;
    if (message.sequence < 0 || !is_between(0, message.t_ns, latest_ns))
        return NOACK_CANNOT_TAKE;
    for (int i = 0; i < 3; i++) {
        const noack_columns *columns = &table->vector[i];
        memcpy(
            message.vector + message.entries, recorded + columns->begin,
            (size_t)columns->entries * sizeof *message.vector);
        message.entries += columns->entries;
    }
    return noack_handle_message(process, replay->loop, &message, now_ns);
}

static int64_t replay_machine(
    noack_input_replay *replay, const noack_recorded_table *table, const uint8_t *recorded,
    int64_t now_ns) {
    noack_process *process = replay->process;
    const noack_output *output = &process->output;
    const noack_message *message = &output->message;
    int64_t question =
        table->kind == NOACK_TICKS ? tick(replay, now_ns) : handle(replay, table, recorded, now_ns);
    if (question != NOACK_DONE)
        return question;
    compare(replay, table, recorded, output->table, 8 * output->words, output->row);
    if (!output->sends || message->entries >= replay->sent_width - SENT_HEADER)
        return NOACK_DONE;
    int64_t *sent = replay->sent + replay->sent_count++ * replay->sent_width;
    sent[0] = message->flow;
    sent[1] = message->sequence;
    sent[2] = message->t_ns;
    memcpy(sent + SENT_HEADER, message->vector, (size_t)message->entries * sizeof *message->vector);
    sent[SENT_HEADER + message->entries] = message->error_level;
    return NOACK_DONE;
}

/* The table of an input, and its row there. */
static const noack_recorded_table *find(
    const noack_input_replay *replay, int64_t place, const uint8_t **row) {
    const noack_recorded_table *table = replay->tables;
    for (; place >= table->count; table++)
        place -= table->count;
    *row = table->rows + place * table->stride;
    return table;
}

int64_t noack_replay_inputs(noack_input_replay *replay) {
    for (; replay->next < replay->count; replay->next++) {
        const uint8_t *recorded;
        const noack_recorded_table *table = find(replay, replay->order[replay->next], &recorded);
        int64_t now_ns = word_at(recorded, NOW), question;
        if (now_ns < replay->before_ns)
            differ(replay, NOACK_TIME_RUNS_BACKWARD, replay->before_ns);
        if (table->kind == NOACK_SETTINGS)
            question = NOACK_REPLAY_SETTING;
        else if (replay->role == NOACK_NETWORK)
            question = replay_network(replay, table, recorded, now_ns);
        else
            question = replay_machine(replay, table, recorded, now_ns);
        if (question != NOACK_DONE)
            return question;
        replay->before_ns = now_ns;
    }
    return NOACK_DONE;
}
