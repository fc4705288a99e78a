/* What the drivers share: the machines, and the network of a run. */
#ifndef NOACK_CHANNEL_H
#define NOACK_CHANNEL_H

#include "../loop/loop.h"

#pragma GCC visibility push(default)
#include "public.h"
#pragma GCC visibility pop

/* Copy what a datagram has. */
static inline void copy_datagram(noack_datagram *to, const noack_datagram *from) {
    size_t entries = (size_t)from->message.entries;
    memcpy(to, from, offsetof(noack_datagram, message.vector) + entries * sizeof(double));
}

#endif
