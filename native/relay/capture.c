/* Formats events as the enhanced packet blocks of a capture (pcapng).

   A block holds the datagram with an IP and a UDP header, and as options a comment, the direction,
   the packet id, and the number of missing events before it.

   Sources: draft-ietf-opsawg-pcapng section 4.3, RFC 791, RFC 8200, RFC 768, RFC 1071 (the
   checksum). */
#include "../core.h"

#include <string.h>

enum { ENHANCED_PACKET = 6, COMMENT = 1, FLAGS = 2, DROPCOUNT = 4, PACKET_ID = 5 };
enum { INBOUND = 1, OUTBOUND = 2 };
enum { IPV4_BYTES = 20, IPV6_BYTES = 40, UDP_BYTES = 8, MOST_PACKET_BYTES = 65535, UDP = 17 };
enum { FATES = NOACK_BLACKED_OUT + 1 };

static const char *const fates[FATES + 1] = {
    "delivered",    "dropped by the loss model", "forced: delivered",
    "corrupted",    "dropped by a full queue",   "dropped in a blackout",
    "unknown fate", /* any other number */
};
static const char stale[] = "delivered out of order (stale)";

const char *noack_capture_check(
    const noack_event *events, int64_t count, int64_t data_bytes, int64_t interfaces) {
    for (int64_t i = 0; i < count; i++) {
        const noack_event *event = &events[i];
        int64_t udp_bytes = (int64_t)event->size_bytes + (event->family == 0 ? 0 : UDP_BYTES);
        if (event->interface >= interfaces)
            return "an event has an interface that does not exist";
        if (event->t_ns < 0)
            return "an event is before 1970";
        if (event->family != 0 && event->family != 4 && event->family != 6)
            return "an event must be of IPv4 or IPv6";
        if (udp_bytes > MOST_PACKET_BYTES - (event->family == 4 ? IPV4_BYTES : 0))
            return "an event has a payload that is too large for a datagram";
        if (event->offset > (uint64_t)data_bytes
            || event->size_bytes > (uint64_t)data_bytes - event->offset)
            return "an event has a payload outside the data";
    }
    return NULL;
}

/* Numbers in the file's order of bytes, and in the network's. Each function returns the end. */

static uint8_t *put_u16(uint8_t *at, int64_t value) {
    at[0] = (uint8_t)value;
    at[1] = (uint8_t)(value >> 8);
    return at + 2;
}

static uint8_t *put_u32(uint8_t *at, int64_t value) {
    return put_u16(put_u16(at, value), value >> 16);
}

static uint8_t *put_network_u16(uint8_t *at, int64_t value) {
    at[0] = (uint8_t)(value >> 8);
    at[1] = (uint8_t)value;
    return at + 2;
}

static uint8_t *put_zeros(uint8_t *at, int64_t size_bytes) {
    memset(at, 0, (size_t)size_bytes);
    return at + size_bytes;
}

/* Texts, which are not terminated. */

static uint8_t *put_text(uint8_t *at, const char *text) {
    size_t size_bytes = strlen(text);
    memcpy(at, text, size_bytes);
    return at + size_bytes;
}

static uint8_t *put_number(uint8_t *at, const char *before, int64_t value) {
    uint64_t rest = (uint64_t)value;
    char digits[20];
    int first = 20;
    at = put_text(at, before);
    if (value < 0) {
        *at++ = '-';
        rest = -rest;
    }
    do {
        digits[--first] = (char)('0' + rest % 10);
        rest /= 10;
    } while (rest > 0);
    memcpy(at, digits + first, (size_t)(20 - first));
    return at + 20 - first;
}

/* Milliseconds, to the microsecond and without trailing zeros. */
static uint8_t *put_ms(uint8_t *at, const char *before, int64_t time_ns) {
    int64_t time_us = (int64_t)(((uint64_t)max_of(time_ns, 0) + 500) / 1000);
    at = put_number(at, before, time_us / 1000);
    int64_t rest = time_us % 1000;
    if (rest > 0)
        *at++ = '.';
    for (int64_t scale = 100; rest > 0; rest %= scale, scale /= 10)
        *at++ = (uint8_t)('0' + rest / scale);
    return put_text(at, " ms");
}

/* The fate, without what it says of times and of other packets. */
static uint8_t *put_fate(uint8_t *at, const noack_event *event) {
    int64_t fate = min_of(event->fate, FATES);
    if (event->copy)
        at = put_text(at, "copy, ");
    at = put_text(at, event->stale && fate == NOACK_DELIVERED ? stale : fates[fate]);
    if (fate == NOACK_FORCED && event->packet == 0 && event->mansd != 0) {
        at = put_text(at, " as the first of its flow");
    } else if (fate == NOACK_FORCED) {
        at = put_text(at, " by the cap");
        if (event->mansd >= 0)
            at = put_text(put_number(at, " of ", event->mansd), " consecutive losses");
    }
    if (event->bit >= 0)
        at = put_number(
            at, fate == NOACK_CORRUPTED ? " in bit " : ", corrupted in bit ", event->bit);
    if (event->stale && fate != NOACK_DELIVERED)
        at = put_text(put_text(at, ", "), stale);
    return at;
}

/* What was decided on arrival: the loss, or the delay. */
static uint8_t *put_decision(uint8_t *at, const noack_event *event) {
    int is_delivered = event->fate == NOACK_DELIVERED || event->fate == NOACK_FORCED;
    if (event->consecutive_losses > 0 && !is_delivered) {
        at = put_number(at, ", consecutive loss ", event->consecutive_losses);
        if (event->mansd >= 0)
            at = put_number(at, ", cap ", event->mansd);
    }
    if (!is_delivered && event->fate != NOACK_CORRUPTED)
        return at;
    if (event->delay_ns > 0)
        at = put_ms(at, ", delayed ", event->delay_ns);
    if (event->hold_back_ns > 0)
        at = put_text(put_ms(at, ", held back ", event->hold_back_ns), " for the guarantee");
    return at;
}

/* Pad with zeros to a multiple of 4, where blocks and options begin. */
static uint8_t *pad(uint8_t *at, const uint8_t *begin) { return put_zeros(at, -(at - begin) & 3); }

static uint8_t *put_comment(uint8_t *option, const noack_event *event) {
    uint8_t *text = option + 4, *at = put_fate(text, event);
    at = event->departure ? put_ms(at, ", after ", event->delay_ns) : put_decision(at, event);
    at = put_number(at, event->direction ? "; reverse, flow " : "; forward, flow ", event->flow);
    at = put_number(at, ", packet ", event->packet);
    put_u16(put_u16(option, COMMENT), at - text);
    return pad(at, text);
}

/* The sum of the words of 16 bits, as of the network; an odd last byte is padded with 0. */
static uint64_t sum_of(const uint8_t *data, int64_t size_bytes) {
    uint64_t upper = 0, lower = 0;
    int64_t i = 0;
    for (; i + 1 < size_bytes; i += 2) {
        upper += data[i];
        lower += data[i + 1];
    }
    if (i < size_bytes)
        upper += data[i];
    return (upper << 8) + lower;
}

static int64_t checksum(uint64_t sum) {
    while (sum > 0xFFFF)
        sum = (sum & 0xFFFF) + (sum >> 16);
    return 0xFFFF - (int64_t)sum;
}

static uint8_t *put_ip_header(uint8_t *at, const noack_event *event, int64_t udp_bytes) {
    if (event->family == 6) {
        static const uint8_t begin[] = {0x60, 0, 0, 0};
        memcpy(at, begin, sizeof begin);
        put_network_u16(at + 4, udp_bytes);
        at[6] = UDP;
        at[7] = 64; /* hop limit */
        memcpy(at + 8, event->source, 16);
        memcpy(at + 24, event->destination, 16);
        return at + IPV6_BYTES;
    }
    put_zeros(at, IPV4_BYTES);
    at[0] = 0x45;
    put_network_u16(at + 2, IPV4_BYTES + udp_bytes);
    at[6] = 0x40; /* not fragmented */
    at[8] = 64;   /* hop limit */
    at[9] = UDP;
    memcpy(at + 12, event->source, 4);
    memcpy(at + 16, event->destination, 4);
    put_network_u16(at + 10, checksum(sum_of(at, IPV4_BYTES)));
    return at + IPV4_BYTES;
}

/* The datagram with its headers, or the whole packet of a device. */
static uint8_t *put_packet(uint8_t *packet, const noack_event *event, const uint8_t *data) {
    int64_t size_bytes = event->size_bytes, udp_bytes = size_bytes + UDP_BYTES;
    if (event->family == 0) {
        memcpy(packet, data + event->offset, (size_t)size_bytes);
        return packet + size_bytes;
    }
    uint8_t *udp = put_ip_header(packet, event, udp_bytes), *at = udp;
    const uint8_t *addresses = packet + (event->family == 4 ? 12 : 8);
    at = put_network_u16(at, event->source_port);
    at = put_network_u16(at, event->destination_port);
    at = put_network_u16(at, udp_bytes);
    at = put_network_u16(at, 0);
    memcpy(at, data + event->offset, (size_t)size_bytes);
    uint64_t pseudo_header = sum_of(addresses, udp - addresses) + UDP + (uint64_t)udp_bytes;
    int64_t sum = checksum(pseudo_header + sum_of(udp, udp_bytes));
    put_network_u16(udp + 6, sum == 0 ? 0xFFFF : sum); /* 0 would mean: no checksum */
    return at + size_bytes;
}

static uint8_t *put_options(uint8_t *at, const noack_event *event, int64_t missing) {
    at = put_comment(at, event);
    at = put_u16(put_u16(at, FLAGS), 4);
    at = put_u32(at, event->departure ? OUTBOUND : INBOUND);
    /* The packet id is the same at both interfaces. */
    at = put_u16(put_u16(at, PACKET_ID), 8);
    at = put_u32(at, event->packet);
    at = put_u32(
        at, (int64_t)(event->interface >> 1) << 25 | (int64_t)event->direction << 24
                | (event->flow & 0xFFFFFF));
    if (missing != 0) {
        at = put_u16(put_u16(at, DROPCOUNT), 8);
        at = put_u32(put_u32(at, missing), missing >> 32);
    }
    return put_u32(at, 0); /* end of options */
}

int64_t noack_capture_blocks(
    const noack_event *events, int64_t count, const uint8_t *data, int64_t *missing,
    int64_t *written, uint8_t *out) {
    uint8_t *at = out;
    for (int64_t i = 0; i < count; i++) {
        const noack_event *event = &events[i];
        uint8_t *block = at, *packet = block + 28;
        at = put_packet(packet, event, data);
        int64_t packet_bytes = at - packet;
        at = put_options(pad(at, packet), event, missing[event->interface]);
        missing[event->interface] = 0;
        written[event->interface]++;

        int64_t block_bytes = at + 4 - block;
        put_u32(put_u32(block, ENHANCED_PACKET), block_bytes);
        put_u32(block + 8, event->interface);
        put_u32(put_u32(block + 12, event->t_ns >> 32), event->t_ns);
        put_u32(put_u32(block + 20, packet_bytes), packet_bytes);
        at = put_u32(at, block_bytes);
    }
    return at - out;
}
