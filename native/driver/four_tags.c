/* The tags of four datagrams at once: a number of each vector belongs to one of them. On an x86-64
   this file is compiled for AVX2, which not every processor has. */
#include "driver.h"

#include <string.h>

typedef uint64_t word __attribute__((vector_size(FOUR * 8)));
#define OF_ALL(number) ((word){number, number, number, number})
#include "../loop/blake2b.h"

void tag_four(
    const noack_wire *wire, int64_t content_bytes, uint8_t *const datagrams[FOUR],
    uint64_t tags[FOUR][NOACK_TAG_BYTES / 8]) {
    uint64_t block[BLOCK_BYTES / 8][FOUR] = {0}, numbers[FOUR];
    word chain[8], words[BLOCK_BYTES / 8];
    for (int64_t k = 0; k < content_bytes / 8; k++)
        for (int lane = 0; lane < FOUR; lane++)
            memcpy(&block[k][lane], datagrams[lane] + 8 * k, 8);
    memcpy(words, block, sizeof block);
    for (int k = 0; k < 8; k++)
        chain[k] = OF_ALL(wire->keyed_state[k]);
    compress(chain, words, (uint64_t)(BLOCK_BYTES + content_bytes), 1);
    for (int k = 0; k < NOACK_TAG_BYTES / 8; k++) {
        memcpy(numbers, &chain[k], sizeof numbers);
        for (int lane = 0; lane < FOUR; lane++)
            tags[lane][k] = numbers[lane];
    }
}
