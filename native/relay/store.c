/* Stores delayed datagrams: payloads in chained blocks. */
#include "relay.h"

#include <stdlib.h>
#include <string.h>

enum { FIRST_SLOTS = 256 };

int64_t blocks_for(int64_t size_bytes) {
    return max_of((size_bytes + NOACK_BLOCK_BYTES - 1) / NOACK_BLOCK_BYTES, 1);
}

/* Whether so much memory and the headroom can be allocated; the check takes microseconds. malloc
   serves blocks of this size from the system, and returns them to it. */
static int has_headroom(const noack_relay *relay, int64_t wanted_bytes) {
    void *volatile memory = malloc((size_t)(relay->headroom_bytes + wanted_bytes));
    free(memory);
    return memory != NULL;
}

/* Double the number of slots. */
static int add_slots(noack_relay *relay) {
    int64_t before = relay->slot_count, count = max_of(2 * before, FIRST_SLOTS);
    if (!lengthen(&relay->heap, before, count, sizeof *relay->heap)
        || !lengthen(&relay->slots, before, count, sizeof *relay->slots)
        || !lengthen(&relay->waiting, before, count, sizeof *relay->waiting))
        return 0;
    for (int64_t k = before; k < count; k++)
        relay->slots[k].next = (int32_t)(k + 1 < count ? k + 1 : relay->free_slot);
    relay->free_slot = before;
    relay->free_slots += count - before;
    relay->slot_count = count;
    return 1;
}

static int add_chunk(noack_relay *relay) {
    int64_t before = relay->block_count, count = before + NOACK_CHUNK_BLOCKS;
    uint8_t *chunk = malloc((size_t)NOACK_CHUNK_BLOCKS * NOACK_BLOCK_BYTES);
    if (chunk == NULL || !lengthen(&relay->block_next, before, count, sizeof *relay->block_next)
        || !lengthen(
            &relay->chunks, before / NOACK_CHUNK_BLOCKS, count / NOACK_CHUNK_BLOCKS,
            sizeof *relay->chunks)) {
        free(chunk);
        return 0;
    }
    relay->chunks[before / NOACK_CHUNK_BLOCKS] = chunk;
    for (int64_t k = before; k < count; k++)
        relay->block_next[k] = (int32_t)(k + 1 < count ? k + 1 : relay->free_block);
    relay->free_block = before;
    relay->free_blocks += NOACK_CHUNK_BLOCKS;
    relay->block_count = count;
    return 1;
}

int make_room(noack_relay *relay, int64_t size_bytes) {
    int lacks_slots = relay->free_slots < 2;
    int lacks_blocks = relay->free_blocks < 2 * blocks_for(size_bytes);
    if (!lacks_slots && !lacks_blocks)
        return 1;
    int64_t slot_bytes =
        (int64_t)(sizeof *relay->heap + sizeof *relay->slots + sizeof *relay->waiting);
    relay->no_memory |= !has_headroom(relay, 2 * relay->slot_count * slot_bytes);
    return !relay->no_memory && (!lacks_slots || add_slots(relay))
           && (!lacks_blocks || add_chunk(relay));
}

uint8_t *block_address(const noack_relay *relay, int64_t block) {
    return relay->chunks[block / NOACK_CHUNK_BLOCKS]
           + block % NOACK_CHUNK_BLOCKS * NOACK_BLOCK_BYTES;
}

/* Store a datagram with its payload, of which the bit that it names is flipped (-1: none); set its
   first block, and return the number of its slot. There must be room. */
int64_t store_payload(noack_relay *relay, const uint8_t *data, noack_slot *datagram) {
    int64_t slot_number = relay->free_slot, size_bytes = datagram->size_bytes, bit = datagram->bit;
    noack_slot *slot = &relay->slots[slot_number];
    relay->free_slot = slot->next;
    relay->free_slots--;
    if (bit >= 0)
        bit += 8 * headers_bytes(relay);
    datagram->block = (int32_t)relay->free_block;
    *slot = *datagram;
    int64_t block = slot->block, last = block;
    for (int64_t begin = 0; begin == 0 || begin < size_bytes; begin += NOACK_BLOCK_BYTES) {
        int64_t length = min_of(size_bytes - begin, NOACK_BLOCK_BYTES), byte = (bit >> 3) - begin;
        uint8_t *place = block_address(relay, block);
        memcpy(place, data + begin, (size_t)length);
        if (bit >= 0 && 0 <= byte && byte < length)
            place[byte] ^= (uint8_t)(1 << (bit & 7));
        last = block;
        block = relay->block_next[block];
    }
    relay->free_block = block;
    relay->block_next[last] = -1;
    relay->free_blocks -= blocks_for(size_bytes);
    return slot_number;
}

/* Free a slot and its blocks. */
void free_payload(noack_relay *relay, int64_t slot_number) {
    noack_slot *slot = &relay->slots[slot_number];
    int64_t count = blocks_for(slot->size_bytes), last = slot->block;
    for (int64_t k = 1; k < count; k++)
        last = relay->block_next[last];
    relay->block_next[last] = (int32_t)relay->free_block;
    relay->free_block = slot->block;
    relay->free_blocks += count;
    slot->next = (int32_t)relay->free_slot;
    relay->free_slot = slot_number;
    relay->free_slots++;
}

void noack_relay_latest(noack_relay *relay, int64_t direction, int64_t *latest_ns) {
    serve(
        relay->directions[direction].link, relay->waiting, INT64_MAX, relay->heap,
        &relay->heap_length);
    for (int64_t i = 0; i < relay->heap_length; i++) {
        const noack_slot *slot = &relay->slots[relay->heap[i].slot];
        if (slot->direction == direction) {
            int64_t row = relay->clients[slot->client].flow_row;
            latest_ns[row] = max_of(latest_ns[row], relay->heap[i].due_ns);
        }
    }
}
