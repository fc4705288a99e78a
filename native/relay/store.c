/* Stores delayed datagrams: payloads in chained blocks. */
#include "relay.h"

#include <string.h>

int64_t blocks_for(int64_t size_bytes) {
    return max_of((size_bytes + NOACK_BLOCK_BYTES - 1) / NOACK_BLOCK_BYTES, 1);
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
