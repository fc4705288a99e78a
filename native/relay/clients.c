/* Clients by address: a hash table with open addressing and linear probing. */
#include "relay.h"

#include <stdlib.h>
#include <string.h>

enum {
    IPV4 = AF_INET,
    TABLE_SHARE = 4, /* places of the table per client */
    FEW = 512        /* the data of so few clients fits into the caches */
};

/* A client's key in five words: family, port, host, scope and link; or the flow through devices. */
static void key_of(
    const noack_relay *relay, const uint8_t name[NOACK_NAME_BYTES], int64_t link, int64_t key[5]) {
    uint64_t words[5];
    memcpy(words, name, sizeof words);
    memset(key, 0, 5 * sizeof *key);
    if (relay->devices)
        memcpy(key, words, sizeof words);
    else if ((words[0] & 0xFFFF) == IPV4) {
        key[0] = (int64_t)words[0];
        key[3] = link << 32;
    } else {
        key[0] = (int64_t)(words[0] & 0xFFFFFFFF); /* without the flow label */
        key[1] = (int64_t)words[1];
        key[2] = (int64_t)words[2];
        key[3] = (int64_t)(words[3] & 0xFFFFFFFF) | link << 32;
    }
}

/* Word by word, as they were just written: memcmp would wait for them to be in the cache. */
static int is_same(const int64_t key[5], const int64_t other[5]) {
    return ((key[0] ^ other[0]) | (key[1] ^ other[1]) | (key[2] ^ other[2]) | (key[3] ^ other[3])
            | (key[4] ^ other[4]))
           == 0;
}

static inline uint64_t rotated(uint64_t word, int bits) {
    return word << bits | word >> (64 - bits);
}

static inline void sip_round(uint64_t v[4]) {
    v[0] += v[1];
    v[1] = rotated(v[1], 13) ^ v[0];
    v[0] = rotated(v[0], 32);
    v[2] += v[3];
    v[3] = rotated(v[3], 16) ^ v[2];
    v[0] += v[3];
    v[3] = rotated(v[3], 21) ^ v[0];
    v[2] += v[1];
    v[1] = rotated(v[1], 17) ^ v[2];
    v[2] = rotated(v[2], 32);
}

/* SipHash-1-3 of a client's key: https://www.aumasson.jp/siphash/siphash.pdf. A sender who chose
   its addresses for a hash without a secret key would let all of them have the same place. */
uint64_t noack_client_hash(const uint64_t secret[2], const int64_t key[5]) {
    uint64_t v[4] = {
        secret[0] ^ UINT64_C(0x736f6d6570736575),
        secret[1] ^ UINT64_C(0x646f72616e646f6d),
        secret[0] ^ UINT64_C(0x6c7967656e657261),
        secret[1] ^ UINT64_C(0x7465646279746573),
    };
    for (int i = 0; i <= 5; i++) {
        uint64_t word =
            i < 5 ? (uint64_t)key[i] : UINT64_C(40) << 56; /* last: the number of bytes */
        v[3] ^= word;
        sip_round(v);
        v[0] ^= word;
    }
    v[2] ^= 0xFF;
    for (int i = 0; i < 3; i++)
        sip_round(v);
    return v[0] ^ v[1] ^ v[2] ^ v[3];
}

/* The first place in the table for a key: its hash. */
static int64_t home_of(const noack_relay *relay, const int64_t key[5]) {
    uint64_t hash = noack_client_hash(relay->secret, key);
    return (int64_t)(hash & (uint64_t)(relay->table_places - 1));
}

int64_t noack_client_find(
    const noack_relay *relay, const uint8_t name[NOACK_NAME_BYTES], int64_t link) {
    int64_t key[5], mask = relay->table_places - 1;
    key_of(relay, name, link, key);
    for (int64_t place = home_of(relay, key);; place = (place + 1) & mask) {
        int64_t row = relay->table[place];
        if (row < 0 || is_same(relay->clients[row].key, key))
            return row;
    }
}

/* The table must have room. */
void noack_client_insert(noack_relay *relay, int64_t row) {
    noack_client *client = &relay->clients[row];
    int64_t mask = relay->table_places - 1;
    key_of(relay, client->name, client->link, client->key);
    int64_t place = home_of(relay, client->key);
    while (relay->table[place] >= 0)
        place = (place + 1) & mask;
    relay->table[place] = (int32_t)row;
}

int add_clients(noack_relay *relay, int64_t rows) {
    int64_t before = relay->client_rows, first = 2 * relay->links;
    void *memory;
    noack_client *clients = zeros_in_lines(rows, sizeof *clients, &memory);
    int32_t *table = zeros(TABLE_SHARE * rows, sizeof *table);
    if (clients == NULL || table == NULL
        || !lengthen(
            &relay->sockets, before == 0 ? 0 : first + before, first + rows,
            sizeof *relay->sockets)) {
        free(memory);
        free(table);
        return 0;
    }
    if (before > 0)
        memcpy(clients, relay->clients, (size_t)before * sizeof *clients);
    free(relay->client_memory);
    free(relay->table);
    relay->clients = clients;
    relay->client_memory = memory;
    relay->table = table;
    relay->table_places = TABLE_SHARE * rows;
    relay->client_rows = rows;
    memset(table, -1, (size_t)relay->table_places * sizeof *table);
    for (int64_t k = before == 0 ? 0 : first + before; k < first + rows; k++)
        relay->sockets[k].fd = -1;
    for (int64_t row = before; row < rows; row++)
        clients[row].number = -1;
    for (int64_t row = 0; row < before; row++)
        if (clients[row].number >= 0)
            noack_client_insert(relay, row);
    return 1;
}

int64_t noack_relay_add_clients(noack_relay *relay) {
    return add_clients(relay, 2 * relay->client_rows);
}

/* Remove a client from the table, and close the gap. */
void noack_client_remove(noack_relay *relay, int64_t row) {
    int32_t *table = relay->table;
    int64_t mask = relay->table_places - 1, gap = home_of(relay, relay->clients[row].key);
    while (table[gap] != row)
        gap = (gap + 1) & mask;
    for (int64_t place = (gap + 1) & mask; table[place] >= 0; place = (place + 1) & mask) {
        int64_t home = home_of(relay, relay->clients[table[place]].key);
        /* An entry may move into the gap unless its home is cyclically after the gap. */
        if (((place - home) & mask) >= ((place - gap) & mask)) {
            table[gap] = table[place];
            gap = place;
        }
    }
    table[gap] = -1;
    relay->clients[row].key[0] = -1; /* no sender's */
}

/* The row of the current datagram's sender; -1: there is none. */
int64_t find_sender(noack_relay *relay) {
    relay_scratch *scratch = scratch_of(relay);
    int64_t key[5], k = scratch->batch_next, row = scratch->hints[k];
    key_of(relay, scratch->in_names[k], scratch->batch_socket, key);
    if (row < 0 || !is_same(relay->clients[row].key, key))
        row = noack_client_find(relay, scratch->in_names[k], scratch->batch_socket);
    if (relay->client_rows <= FEW) /* the next datagram often has the same sender */
        scratch->hints[(k + 1) % BUFFERS] = (int32_t)row;
    return row;
}

/* The row that the table has first for the sender of datagram k; -1: none. */
static int32_t row_of(const noack_relay *relay, int64_t k) {
    const relay_scratch *scratch = scratch_of(relay);
    int64_t key[5];
    key_of(relay, scratch->in_names[k], scratch->batch_socket, key);
    return relay->table[home_of(relay, key)];
}

/* Load the data of the clients of the received batch into the caches, if it is from a listening
   socket. Thousands of clients do not fit into the caches. One datagram after the other would wait
   for the memory at each of its clients' tables. Here the same loads of all datagrams wait
   together. */
void touch_clients(noack_relay *relay) {
    relay_scratch *scratch = scratch_of(relay);
    uint64_t loaded = 0;
    if (relay->client_rows <= FEW || client_of_socket(relay, scratch->batch_socket) >= 0
        || relay->devices)
        return;
    const noack_link *link = relay->directions[2 * scratch->batch_socket].link;
    for (int64_t k = scratch->batch_next; k < scratch->batch_end; k++)
        scratch->hints[k] = row_of(relay, k);
    for (int64_t k = scratch->batch_next; k < scratch->batch_end; k++) {
        int64_t row = scratch->hints[k];
        if (row >= 0)
            loaded += (uint64_t)relay->clients[row].key[0] + (uint64_t)relay->clients[row].flow_row
                      + (uint64_t)relay->sockets[socket_of_client(relay, row)].fd;
    }
    for (int64_t k = scratch->batch_next; k < scratch->batch_end; k++) {
        int64_t row = scratch->hints[k];
        if (row >= 0 && relay->clients[row].link == scratch->batch_socket)
            loaded += (uint64_t)noack_link_touch(link, relay->clients[row].flow_row);
    }
    scratch->loaded = loaded;
}
