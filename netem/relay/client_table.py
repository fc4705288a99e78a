"""A relay's clients, which :class:`ClientTable` accepts, finds and forgets.

Each has a row in the relay's memory, and may have a return path.
"""

import errno
from collections.abc import Iterator, Sequence

import numpy as np

from netem.core.address import packed_name
from netem.core.core_library import CData, core
from netem.core.udp_sockets import drops_of
from netem.relay.link_sockets import Endpoint, has_data, return_path, stamp_arrivals
from netem.relay.loss_warnings import LinkWarnings
from netem.relay.relay_links import DeviceLink, OpenLink
from netem.relay.relay_memory import RelayDirection, RelayMemory

_QUERIED_AT_ONCE = 64
"""Return paths whose drop counters are queried in one turn of housekeeping."""
_STALL_NS = 1_000_000_000
"""A relay that has not checked for idle clients for this time was stopped, or got no CPU time."""


class ClientTable:
    """All clients of a relay."""

    def __init__(
        self,
        links: Sequence[OpenLink | DeviceLink],
        warnings: Sequence[LinkWarnings],
        directions: Sequence[RelayDirection],
        memory: RelayMemory,
    ) -> None:
        self._links, self._warnings, self._directions = links, warnings, directions
        self._memory = memory
        self._free_rows = list(reversed(range(len(memory.clients))))
        self._free_flow_rows: list[list[int]] = [[] for _ in links]
        self._used_flow_rows = [0] * len(links)
        self.total_counts = [0] * len(links)
        """(links,) Clients so far."""
        self.present_counts = [0] * len(links)
        """(links,) Clients that are in the table."""
        self._paths: dict[int, Endpoint] = {}
        self._drops: dict[int, int] = {}
        self.drops = [0] * len(links)
        """(links,) Datagrams dropped by the kernel at the return paths, when last queried."""
        self._outside_rows: set[int] = set()
        """Flows through the devices of a shell that began outside."""
        self._not_queried: Iterator[int] = iter(())
        self._without_path: set[int] = set()
        """Clients whose return path could not be opened."""
        self._idle_ns = np.array([round(link.spec.idle_s * 1e9) for link in links], np.int64)
        self._expired_ns = self._next_idle_ns = 0

    def add(self, link: int, name: bytes, *, from_outside: bool = False) -> None:
        """Add a client by its packed name; if that is impossible, refuse clients until one leaves.

        Half of the flows through the devices of a shell are reserved for those that begin inside:
        any host may send to the outside of a shell.
        """
        present, most = self.present_counts[link], self._links[link].spec.most_clients
        if from_outside and len(self._outside_rows) >= most // 2:
            self._warnings[link].report_flood(most // 2)
            self._set_full(2 * link + 1, True)
            return
        if present >= most:
            self._warnings[link].report_full()
            self._set_full(2 * link + from_outside, True)
            return
        path, error = None, 0
        if self._links[link].has_paths:
            path, error = return_path(self._links[link].server)
            if error in (errno.EMFILE, errno.ENFILE):
                self._warnings[link].report_no_descriptor(present)
                self._set_full(2 * link, True)
                return
        row = self._accept(link, name, path, error)
        if from_outside:
            self._outside_rows.add(row)

    def expire(self, now_ns: int) -> None:
        """Remove the clients that have been idle and have no datagram in flight."""
        if now_ns - self._expired_ns > _STALL_NS:
            # The relay was stopped: datagrams that arrived meanwhile have not been read yet.
            self._memory.clients["last_ns"] = now_ns
        self._expired_ns = now_ns
        if now_ns > self._next_idle_ns:
            self._remove_idle(now_ns)
        for link, present in enumerate(self.present_counts):
            if present == 0:  # full for lack of a file descriptor; no client can make room
                self._set_full(2 * link, False)

    def reconnect(self) -> None:
        """Open the return paths again that could not be opened before."""
        for row in tuple(self._without_path):
            server = self._links[self._memory.core.clients[row].link].server
            path, self._socket(row).error = return_path(server)
            if path is not None:
                self._set_path(row, path)

    def query_some_drops(self) -> None:
        """Query the kernel's drop counters of some return paths; successive calls cover all."""
        for _ in range(_QUERIED_AT_ONCE):
            row = next(self._not_queried, None)
            if row is None:
                self._not_queried = iter(tuple(self._paths))
                return
            if row in self._paths:
                self._query_drops(row)

    def query_all_drops(self) -> None:
        """Query the kernel's drop counters of all return paths."""
        for row in self._paths:
            self._query_drops(row)

    def rows_of(self, link: int) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
        """Return the rows of a link's clients."""
        clients = self._memory.clients
        return np.flatnonzero((clients["number"] >= 0) & (clients["link"] == link))

    def text(self, row: int) -> str:
        """Return a client's address, or its flow, as text."""
        client = self._memory.clients[row]
        return self._links[int(client["link"])].client_text(client["name"].tobytes())

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

    def _remove_idle(self, now_ns: int) -> None:
        """Remove idle clients; note when the next one can be idle."""
        clients = self._memory.clients
        present = clients["number"] >= 0
        idle_from_ns = clients["last_ns"] + self._idle_ns[clients["link"]]
        for row in np.flatnonzero(present & (idle_from_ns < now_ns) & (clients["in_flight"] == 0)).tolist():
            path = self._paths.get(row)
            if path is None or not has_data(path):
                self._forget(row)
        # Clients that come later are idle no sooner than those that come now.
        of_new_ns = now_ns + int(self._idle_ns.min())
        self._next_idle_ns = int(idle_from_ns[present].min(initial=of_new_ns))

    def _accept(self, link: int, name: bytes, path: Endpoint | None, error: int) -> int:
        """Add a client; return its row."""
        if not self._free_rows:
            self._grow()
        row = self._free_rows.pop()
        if self._free_flow_rows[link]:
            flow_row = self._free_flow_rows[link].pop()
        else:
            flow_row = self._used_flow_rows[link]
            self._used_flow_rows[link] += 1
        number = self.total_counts[link]
        self.total_counts[link] += 1
        self.present_counts[link] += 1
        for direction in self._directions[2 * link : 2 * link + 2]:
            direction.start_flow(flow_row, number)
        relay = self._memory.core
        _, name_bytes = packed_name(self._links[link].name)
        client = relay.clients[row]
        client.last_ns = relay.now_ns
        client.number, client.link, client.flow_row = number, link, flow_row
        client.in_flight = 0
        client.name, client.name_bytes = name, name_bytes
        core.noack_client_insert(relay, row)
        self._socket(row).error, self._socket(row).fd = error, -1
        if path is not None:
            self._set_path(row, path)
        elif error:
            self._without_path.add(row)
        return row

    def _socket(self, row: int) -> CData:
        return self._memory.core.sockets[self._memory.first_path + row]

    def _set_path(self, row: int, path: Endpoint) -> None:
        memory = self._memory
        if self._directions[2 * memory.core.clients[row].link + 1].needs_arrivals:
            stamp_arrivals(path)
        self._paths[row] = path
        self._without_path.discard(row)
        self._drops[row] = 0
        memory.watch(path.fileno(), memory.first_path + row)

    def _forget(self, row: int) -> None:
        relay = self._memory.core
        client, link = relay.clients[row], relay.clients[row].link
        core.noack_client_remove(relay, row)
        if row in self._paths:
            self._query_drops(row)
            del self._drops[row]
            self._paths.pop(row).close()
        client.number = self._socket(row).fd = -1
        self._socket(row).error = 0
        self._without_path.discard(row)
        self._free_rows.append(row)
        self._free_flow_rows[link].append(client.flow_row)
        self.present_counts[link] -= 1
        self._outside_rows.discard(row)
        for direction in (2 * link, 2 * link + 1):
            self._set_full(direction, False)

    def _set_full(self, direction: int, full: bool) -> None:
        self._directions[direction].row.full = full

    def _grow(self) -> None:
        count = len(self._memory.clients)
        self._memory.add_clients()
        self._free_rows.extend(reversed(range(count, 2 * count)))

    def _query_drops(self, row: int) -> None:
        drops = drops_of(self._paths[row])
        if drops is not None:
            self.drops[self._memory.core.clients[row].link] += drops - self._drops[row]
            self._drops[row] = drops
