"""Clients of the Linux engine: a row in the pump's memory and a return path for each."""

import errno
from collections.abc import Iterator, Sequence

import numpy as np

from netem.engine.batched_directions import BatchedDirection
from netem.engine.compiled_pump import Functions
from netem.engine.epoll_waiter import Epoll
from netem.engine.link_listeners import OpenLink
from netem.engine.pump_memory import PumpMemory
from netem.engine.refused_clients import STOPPED_NS, RefusedClients
from netem.engine.relay_interface import Address
from netem.engine.relay_sockets import (
    Endpoint,
    ListenAddress,
    has_data,
    return_path,
    stamp_arrivals,
)
from netem.engine.socket_names import address_of_name, name_of
from noack.runtime.udp_sockets import drops_of

_LOOKED_AT = 256


class ClientTable:
    """All clients of a relay.

    Args:
        links: the links.
        ways: (2 · links,) forward and reverse direction of each link.
        memory: the pump's memory.
        functions: the compiled functions of the pump.
        epoll: the epoll object with which the pump waits.
    """

    def __init__(
        self,
        links: Sequence[OpenLink],
        ways: Sequence[BatchedDirection],
        memory: PumpMemory,
        functions: Functions,
        epoll: Epoll,
    ) -> None:
        self._links, self._ways = links, ways
        self._memory, self._functions, self._epoll = memory, functions, epoll
        self._free_rows = list(reversed(range(len(memory.memory.clients))))
        self._free_places: list[list[int]] = [[] for _ in links]
        self._places = [0] * len(links)
        self.ever = [0] * len(links)
        self.now = [0] * len(links)
        self._paths: dict[int, Endpoint] = {}
        self._drops: dict[int, int] = {}
        self.drops = [0] * len(links)
        """(links,) Datagrams dropped by the kernel at the return paths, when last queried."""
        self._unasked: Iterator[int] = iter(())
        self._idle_ns = np.array([round(link.spec.idle_s * 1e9) for link in links], np.int64)
        self._refusals = [RefusedClients(link.spec) for link in links]
        self._expired_ns = 0

    def add(self, link: int, name: bytes) -> None:
        """Add a client; if that is impossible, mark the link as full.

        Args:
            link: number of the client's link.
            name: its socket address, NAME_BYTES long.
        """
        refusals, path, error = self._refusals[link], None, 0
        if refusals.accepts(self.now[link]) and self._links[link].spec.return_path:
            try:
                path = return_path(self._links[link].server)
            except OSError as failure:
                error = failure.errno or errno.EIO
                refusals.is_exhausted(error, self.now[link])
        if refusals.accepts(self.now[link]):
            self._take(link, name, path, error)
        else:
            self._memory.memory.directions["full"][2 * link] = 1

    def expire(self, now_ns: int) -> None:
        """Remove the clients that have been idle and have no datagram in flight."""
        clients = self._memory.memory.clients
        if now_ns - self._expired_ns > STOPPED_NS:
            # The engine was stopped: datagrams that arrived meanwhile have not been read yet.
            clients["last_ns"] = now_ns
        self._expired_ns = now_ns
        since_ns = now_ns - self._idle_ns[clients["link"]]
        idle = (clients["number"] >= 0) & (clients["last_ns"] < since_ns)
        for row in np.flatnonzero(idle & (clients["in_flight"] == 0)).tolist():
            path = self._paths.get(row)
            if path is None or not has_data(path):
                self._forget(row)

    def reconnect(self) -> None:
        """Open the return paths again that could not be opened before."""
        sockets, first = self._memory.memory.sockets, self._memory.first_path
        clients = self._memory.memory.clients
        for row in np.flatnonzero(sockets["error"][first:]).tolist():
            try:
                path = return_path(self._links[clients["link"][row]].server)
            except OSError as failure:
                sockets["error"][first + row] = failure.errno or errno.EIO
            else:
                self._set_path(row, path)

    def ask_some(self) -> None:
        """Query the kernel's drop counters of some return paths; successive calls cover all."""
        for _ in range(_LOOKED_AT):
            row = next(self._unasked, None)
            if row is None:
                self._unasked = iter(tuple(self._paths))
                return
            if row in self._paths:
                self._ask(row)

    def ask_all(self) -> None:
        """Query the kernel's drop counters of all return paths."""
        for row in self._paths:
            self._ask(row)

    def rows_of(self, link: int) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
        """Return the rows of a link's clients."""
        clients = self._memory.memory.clients
        return np.flatnonzero((clients["number"] >= 0) & (clients["link"] == link))

    def address(self, row: int) -> Address:
        """Return a client's address."""
        return address_of_name(self._memory.memory.clients["name"][row].tobytes())

    def stamp_arrivals(self, link: int) -> None:
        """Enable kernel timestamps for the answers to a link's clients."""
        for row in self.rows_of(link).tolist():
            if row in self._paths:
                stamp_arrivals(self._paths[row])

    def close(self) -> None:
        """Close all return paths."""
        for path in self._paths.values():
            path.close()
        self._paths.clear()

    def _take(self, link: int, name: bytes, path: Endpoint | None, error: int) -> None:
        if not self._free_rows:
            self._grow()
        row = self._free_rows.pop()
        free = self._free_places[link]
        if free:
            place = free.pop()
        else:
            place = self._places[link]
            self._places[link] += 1
        number = self.ever[link]
        self.ever[link] += 1
        self.now[link] += 1
        for way in self._ways[2 * link : 2 * link + 2]:
            way.start_flow(place, number)
        memory = self._memory.memory
        _, name_bytes = name_of(self._links[link].here)
        local, _ = name_of(self._links[link].local)
        client = memory.clients[row]
        client["last_ns"] = self._memory.pump["now_ns"]
        client["number"], client["link"], client["place"] = number, link, place
        client["in_flight"] = 0
        client["name_bytes"] = name_bytes
        memory.clients["name"][row] = np.frombuffer(name, np.uint8)
        memory.clients["local"][row] = np.frombuffer(local, np.uint8)
        self._insert(row)
        memory.sockets["error"][self._memory.first_path + row] = error
        memory.sockets["fd"][self._memory.first_path + row] = -1
        if path is not None:
            self._set_path(row, path)

    def _set_path(self, row: int, path: Endpoint) -> None:
        memory, place = self._memory.memory, self._memory.first_path + row
        if self._ways[2 * int(memory.clients["link"][row]) + 1].program.tracks:
            stamp_arrivals(path)
        self._paths[row] = path
        self._drops[row] = 0
        memory.sockets["fd"][place] = path.fileno()
        memory.sockets["error"][place] = 0
        local, _ = name_of(ListenAddress(int(path.family), path.getsockname()))
        memory.clients["local"][row] = np.frombuffer(local, np.uint8)
        self._epoll.add(path.fileno(), place)

    def _forget(self, row: int) -> None:
        memory = self._memory.memory
        link, place = int(memory.clients["link"][row]), int(memory.clients["place"][row])
        self._functions.remove(memory.table, memory.clients, row)
        if row in self._paths:
            self._ask(row)
            del self._drops[row]
            self._paths.pop(row).close()
        memory.clients["number"][row] = -1
        memory.sockets["fd"][self._memory.first_path + row] = -1
        memory.sockets["error"][self._memory.first_path + row] = 0
        self._free_rows.append(row)
        self._free_places[link].append(place)
        self.now[link] -= 1
        memory.directions["full"][2 * link] = 0
        self._refusals[link].end()

    def _grow(self) -> None:
        count = len(self._memory.memory.clients)
        self._memory.add_clients()
        memory = self._memory.memory
        for row in np.flatnonzero(memory.clients["number"] >= 0).tolist():
            self._insert(row)
        self._free_rows.extend(reversed(range(count, 2 * count)))

    def _insert(self, row: int) -> None:
        memory = self._memory.memory
        # A writable copy has the array type for which the function was compiled.
        name = np.frombuffer(memory.clients["name"][row].tobytes(), np.int64).copy()
        self._functions.insert(memory.table, memory.clients, row, name)

    def _ask(self, row: int) -> None:
        found = drops_of(self._paths[row])
        if found is not None:
            self.drops[int(self._memory.memory.clients["link"][row])] += found - self._drops[row]
            self._drops[row] = found
