/* What the network reads in the header of a run's datagram; native/loop/wire.c has the rest of the
   wire format. Nothing is verified: the network has no key. */
#include "run_header.h"

#include "network.h"

int64_t header_loop(const uint8_t *datagram, int64_t size_bytes) {
    return size_bytes < NOACK_HEADER_BYTES ? -1 : datagram[LOOP] | datagram[LOOP + 1] << 8;
}

int64_t header_flow(const uint8_t *datagram, int64_t size_bytes) {
    return size_bytes < NOACK_HEADER_BYTES ? -1 : datagram[FLOW];
}

int64_t header_error_level(const uint8_t *datagram, int64_t size_bytes) {
    if (header_flow(datagram, size_bytes) != NOACK_UPDATE || datagram[0] != 'N'
        || datagram[1] != 'A' || (datagram[2] != VERSION && datagram[2] != ENCRYPTED_VERSION))
        return 0;
    return datagram[ERROR_LEVEL];
}
