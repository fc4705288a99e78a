/* BLAKE2b's compression of a block. The file that includes it defines `word`: uint64_t, or a vector
   with a number of each of several messages; and OF_ALL, which makes such a vector of a number. */
#include <stdint.h>

enum { BLOCK_BYTES = 128, ROUNDS = 12 };

static const uint64_t initial[8] = {
    UINT64_C(0x6A09E667F3BCC908), UINT64_C(0xBB67AE8584CAA73B), UINT64_C(0x3C6EF372FE94F82B),
    UINT64_C(0xA54FF53A5F1D36F1), UINT64_C(0x510E527FADE682D1), UINT64_C(0x9B05688C2B3E6C1F),
    UINT64_C(0x1F83D9ABFB41BD6B), UINT64_C(0x5BE0CD19137E2179),
};

static inline word rotate(word number, int bits) { return number >> bits | number << (64 - bits); }

/* RFC 7693, Section 3.1 */
static inline void mix(word v[16], int a, int b, int c, int d, word x, word y) {
    v[a] = v[a] + v[b] + x;
    v[d] = rotate(v[d] ^ v[a], 32);
    v[c] = v[c] + v[d];
    v[b] = rotate(v[b] ^ v[c], 24);
    v[a] = v[a] + v[b] + y;
    v[d] = rotate(v[d] ^ v[a], 16);
    v[c] = v[c] + v[d];
    v[b] = rotate(v[b] ^ v[c], 63);
}

/* RFC 7693, Section 2.7: the order of a block's words in each round. */
static const uint8_t orders[10][16] = {
    {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15},
    {14, 10, 4, 8, 9, 15, 13, 6, 1, 12, 0, 2, 11, 7, 5, 3},
    {11, 8, 12, 0, 5, 2, 15, 13, 10, 14, 3, 6, 7, 1, 9, 4},
    {7, 9, 3, 1, 13, 12, 11, 14, 2, 6, 5, 10, 4, 0, 15, 8},
    {9, 0, 5, 7, 2, 4, 10, 15, 14, 1, 11, 12, 6, 8, 3, 13},
    {2, 12, 6, 10, 0, 11, 8, 3, 4, 13, 7, 5, 15, 14, 1, 9},
    {12, 5, 1, 15, 14, 13, 4, 10, 0, 7, 6, 3, 9, 2, 8, 11},
    {13, 11, 7, 14, 12, 1, 3, 9, 5, 0, 15, 4, 8, 6, 2, 10},
    {6, 15, 14, 9, 11, 3, 0, 8, 12, 2, 13, 7, 1, 4, 10, 5},
    {10, 2, 8, 4, 7, 6, 1, 5, 15, 11, 9, 14, 3, 12, 13, 0},
};

/* RFC 7693, Section 3.2: count is the number of bytes up to the end of this block. */
static void compress(word chain[8], const word m[16], uint64_t count, int is_last) {
    word v[16];
    for (int k = 0; k < 8; k++) {
        v[k] = chain[k];
        v[8 + k] = OF_ALL(initial[k]);
    }
    v[12] ^= OF_ALL(count);
    if (is_last)
        v[14] = ~v[14];
    /* Unrolled, the order of the words is known to the compiler: 147 instead of 215 ns. */
#ifndef __OPTIMIZE_SIZE__ /* for a board: an eighth of the code */
#pragma GCC unroll 12
#endif
    for (int round = 0; round < ROUNDS; round++) {
        const uint8_t *at = orders[round % 10];
        mix(v, 0, 4, 8, 12, m[at[0]], m[at[1]]);
        mix(v, 1, 5, 9, 13, m[at[2]], m[at[3]]);
        mix(v, 2, 6, 10, 14, m[at[4]], m[at[5]]);
        mix(v, 3, 7, 11, 15, m[at[6]], m[at[7]]);
        mix(v, 0, 5, 10, 15, m[at[8]], m[at[9]]);
        mix(v, 1, 6, 11, 12, m[at[10]], m[at[11]]);
        mix(v, 2, 7, 8, 13, m[at[12]], m[at[13]]);
        mix(v, 3, 4, 9, 14, m[at[14]], m[at[15]]);
    }
    for (int k = 0; k < 8; k++)
        chain[k] ^= v[k] ^ v[k + 8];
}
