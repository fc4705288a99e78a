/* The header of a run's datagram (docs/wire.md): where its fields are. */
#ifndef NOACK_RUN_HEADER_H
#define NOACK_RUN_HEADER_H

enum {
    VERSION = 1,
    ENCRYPTED_VERSION = 2,
    FLOW = 3,
    DIMENSION = 4,
    ERROR_LEVEL = 5,
    LOOP = 6,
    RUN = 8,
    SEQUENCE = 16,
    TIME = 24,
    VECTOR = 32
};

#endif
