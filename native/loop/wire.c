/* The wire format of docs/wire.md: datagrams and the tests that a receiver makes. */
#include <math.h>
#include <string.h>

#include "../network/run_header.h"
#include "loop.h"

typedef uint64_t word;
#define OF_ALL(number) (number)
#include "blake2b.h"

void noack_wire_key(noack_wire *wire, const uint8_t key[NOACK_KEY_BYTES]) {
    uint64_t block[16] = {0};
    memcpy(block, key, NOACK_KEY_BYTES);
    memcpy(wire->keyed_state, initial, sizeof initial);
    wire->keyed_state[0] ^= 0x01010000 ^ NOACK_KEY_BYTES << 8 ^ NOACK_TAG_BYTES;
    compress(wire->keyed_state, block, BLOCK_BYTES, 0);
}

/* The tag of at least one byte of content. */
static void tag_of(
    const noack_wire *wire, int64_t size_bytes, const uint8_t *content,
    uint8_t tag[NOACK_TAG_BYTES]) {
    uint64_t chain[8], block[16];
    memcpy(chain, wire->keyed_state, sizeof chain);
    uint64_t count = BLOCK_BYTES;
    while (size_bytes > BLOCK_BYTES) {
        memcpy(block, content, BLOCK_BYTES);
        content += BLOCK_BYTES;
        size_bytes -= BLOCK_BYTES;
        compress(chain, block, count += BLOCK_BYTES, 0);
    }
    memset(block, 0, sizeof block);
    memcpy(block, content, (size_t)size_bytes);
    compress(chain, block, count + (uint64_t)size_bytes, 1);
    memcpy(tag, chain, NOACK_TAG_BYTES);
}

void noack_wire_header(const noack_wire *wire, const noack_message *message, uint8_t *datagram) {
    uint16_t loop = (uint16_t)message->loop;
    datagram[0] = 'N';
    datagram[1] = 'A';
    datagram[2] = wire->encrypted ? ENCRYPTED_VERSION : VERSION;
    datagram[FLOW] = (uint8_t)message->flow;
    datagram[DIMENSION] = (uint8_t)message->entries;
    datagram[ERROR_LEVEL] = (uint8_t)message->error_level;
    memcpy(datagram + LOOP, &loop, sizeof loop);
    memcpy(datagram + RUN, &wire->run_id, 8);
    memcpy(datagram + SEQUENCE, &message->sequence, 8);
    memcpy(datagram + TIME, &message->t_ns, 8);
}

int64_t write_content(const noack_wire *wire, const noack_message *message, uint8_t *datagram) {
    noack_wire_header(wire, message, datagram);
    memcpy(datagram + VECTOR, message->vector, 8 * (size_t)message->entries);
    return VECTOR + 8 * message->entries;
}

void write_tag(const noack_wire *wire, int64_t content_bytes, uint8_t *datagram) {
    tag_of(wire, content_bytes, datagram, datagram + content_bytes);
}

int64_t noack_wire_encode(const noack_wire *wire, const noack_message *message, uint8_t *datagram) {
    int64_t content_bytes = write_content(wire, message, datagram);
    if (!wire->encrypted)
        write_tag(wire, content_bytes, datagram);
    return content_bytes + NOACK_TAG_BYTES;
}

/* The tests that need no key: they reject most invalid input and name common mistakes. */
static int64_t examine_header(
    const noack_wire *wire, const noack_reception *reception, int64_t loop, const uint8_t *datagram,
    int64_t size_bytes) {
    if (size_bytes < NOACK_HEADER_BYTES)
        return NOACK_BAD_LENGTH;
    int version = wire->encrypted ? ENCRYPTED_VERSION : VERSION;
    if (datagram[0] != 'N' || datagram[1] != 'A' || datagram[2] != version)
        return NOACK_BAD_VERSION;
    int64_t entries = datagram[DIMENSION];
    if (entries != reception->entries || entries > NOACK_MAX_ENTRIES
        || size_bytes != VECTOR + 8 * entries + NOACK_TAG_BYTES)
        return NOACK_BAD_LENGTH;
    if (memcmp(datagram + RUN, &wire->run_id, 8) != 0)
        return NOACK_BAD_RUN;
    if (datagram[FLOW] != reception->flow)
        return NOACK_BAD_FLOW;
    return header_loop(datagram, size_bytes) == loop ? NOACK_ACCEPTED : NOACK_BAD_LOOP;
}

int is_tag(const uint64_t tag[NOACK_TAG_BYTES / 8], const uint8_t *bytes) {
    uint64_t received[2];
    memcpy(received, bytes, sizeof received);
    /* Both words are compared in any case: the time must not depend on the first. */
    return ((tag[0] ^ received[0]) | (tag[1] ^ received[1])) == 0;
}

static int has_tag(const noack_wire *wire, const uint8_t *datagram, int64_t content_bytes) {
    uint64_t tag[2];
    tag_of(wire, content_bytes, datagram, (uint8_t *)tag);
    return is_tag(tag, datagram + content_bytes);
}

int64_t noack_wire_examine_message(
    const noack_reception *reception, int64_t from_peer, const noack_message *message) {
    if (!from_peer)
        return NOACK_BAD_SOURCE;
    /* Sequence numbers from 2^63 on are negative here. */
    if (message->sequence < 0 || message->t_ns < 0 || message->t_ns > reception->not_after_ns)
        return NOACK_BAD_RANGE;
    if (message->sequence <= reception->newest)
        return NOACK_STALE;
    for (int64_t k = 0; k < message->entries; k++)
        if (!isfinite(message->vector[k]))
            return NOACK_NOT_FINITE;
    return NOACK_ACCEPTED;
}

int64_t noack_wire_examine(
    const noack_wire *wire, const noack_reception *reception, int64_t loop, const uint8_t *datagram,
    int64_t size_bytes, int64_t from_peer, int64_t opened, noack_message *message) {
    int64_t examination = examine_header(wire, reception, loop, datagram, size_bytes);
    if (examination != NOACK_ACCEPTED)
        return examination;
    if (wire->encrypted && !opened)
        return NOACK_ENCRYPTED;
    if (!wire->encrypted && !opened && !has_tag(wire, datagram, size_bytes - NOACK_TAG_BYTES))
        return NOACK_BAD_TAG;
    message->flow = reception->flow;
    message->loop = loop;
    message->entries = reception->entries;
    message->error_level = datagram[ERROR_LEVEL];
    memcpy(&message->sequence, datagram + SEQUENCE, 8);
    memcpy(&message->t_ns, datagram + TIME, 8);
    memcpy(message->vector, datagram + VECTOR, 8 * (size_t)message->entries);
    return noack_wire_examine_message(reception, from_peer, message);
}

void noack_wire_count(
    noack_reception *reception, int64_t examination, const noack_message *message) {
    if (examination == NOACK_ACCEPTED) {
        reception->newest = message->sequence;
        reception->accepted++;
    } else if (0 <= examination && examination < NOACK_REJECTIONS) {
        reception->rejected[examination]++;
    }
}
