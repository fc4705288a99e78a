"""Clients by address: a hash table with open addressing and linear probing."""

from netem.engine.pump.pump_layout import Array

_AF_INET = 2
_LOW_WORD = 0xFFFFFFFF
_GOLDEN = -7046029254386353131
"""2⁶⁴/φ as a signed integer."""


def key_of(name: Array, link: int) -> tuple[int, int, int, int]:
    """Return a client's key in four words: family, port, host, scope and link.

    ``name`` is the client's socket address, (4,) int64.
    """
    if name[0] & 0xFFFF == _AF_INET:
        return name[0], 0, 0, link << 32
    return name[0] & _LOW_WORD, name[1], name[2], (name[3] & _LOW_WORD) | (link << 32)


def find(table: Array, clients: Array, key0: int, key1: int, key2: int, key3: int) -> int:
    """Return the row of the client with a key; −1 if there is none."""
    mask = len(table) - 1
    place = home_of(table, key0, key1, key2, key3)
    while table[place] >= 0:
        client = clients[table[place]]
        if (
            client.key0 == key0
            and client.key1 == key1
            and client.key2 == key2
            and client.key3 == key3
        ):
            return table[place]
        place = (place + 1) & mask
    return -1


def insert(table: Array, clients: Array, row: int, name: Array) -> None:
    """Insert a client with a socket address, (4,) int64; the table must have room."""
    client = clients[row]
    key0, key1, key2, key3 = key_of(name, client.link)
    client.key0 = key0
    client.key1 = key1
    client.key2 = key2
    client.key3 = key3
    mask = len(table) - 1
    place = _home(table, clients, row)
    while table[place] >= 0:
        place = (place + 1) & mask
    table[place] = row


def remove(table: Array, clients: Array, row: int) -> None:
    """Remove a client from the table, and close the gap."""
    mask = len(table) - 1
    gap = _home(table, clients, row)
    while table[gap] != row:
        gap = (gap + 1) & mask
    place = gap
    while True:
        place = (place + 1) & mask
        if table[place] < 0:
            break
        home = _home(table, clients, table[place])
        # An entry may move into the gap unless its home is cyclically after the gap.
        if ((place - home) & mask) >= ((place - gap) & mask):
            table[gap] = table[place]
            gap = place
    table[gap] = -1


def _home(table: Array, clients: Array, row: int) -> int:
    client = clients[row]
    return home_of(table, client.key0, client.key1, client.key2, client.key3)


def home_of(table: Array, key0: int, key1: int, key2: int, key3: int) -> int:
    """Return the first place in the table for a key, its hash; the product overflows on purpose."""
    mixed = 0
    for word in (key0, key1, key2, key3):
        mixed = (mixed ^ word) * _GOLDEN
        mixed ^= mixed >> 29
    return mixed & (len(table) - 1)
