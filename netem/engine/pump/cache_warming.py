"""Loads the data of a batch's clients into the processor's caches before the decisions.

Thousands of clients do not fit into the caches. One datagram after the other would wait for the
memory at each of its clients' tables. Here the same loads of all datagrams wait together.
"""

from typing import Any

from netem.engine.pump.client_table import home_of, key_of
from netem.engine.pump.pump_layout import Memory
from noack.runtime.native.libc_calls import link_touch

_FEW = 512
"""The data of this number of clients fits into the caches."""


def warm_clients(memory: Memory) -> None:
    """Load the data of the clients of the received batch, if it is from a listening socket."""
    pump = memory.pump[0]
    if len(memory.clients) <= _FEW or pump.batch_socket >= pump.first_path:
        return
    direction: Any = memory.directions[2 * pump.batch_socket]
    loaded = 0
    for k in range(pump.batch_next, pump.batch_end):
        loaded += _row_of(memory, k)
    for k in range(pump.batch_next, pump.batch_end):
        row = _row_of(memory, k)
        if row >= 0:
            client = memory.clients[row]
            loaded += client.key0 + client.place + memory.sockets[pump.first_path + row].fd
    for k in range(pump.batch_next, pump.batch_end):
        row = _row_of(memory, k)
        if row >= 0:
            loaded += link_touch(direction.link, memory.clients[row].place)
    pump.loaded = loaded


def _row_of(memory: Memory, k: int) -> int:
    """Return the row that the hash table has first for the sender of datagram k; −1: none."""
    key0, key1, key2, key3 = key_of(memory.in_names[k], memory.pump[0].batch_socket)
    return memory.table[home_of(memory.table, key0, key1, key2, key3)]
