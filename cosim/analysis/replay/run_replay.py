"""The replay of a run: its network, each of its loops, and the messages between processes.

Every message that the next process received must be bit-identical to one that a process sends in
its replay. Messages that were lost in the network are not compared.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.replay.machine_replay import (
    SEQUENCE,
    TIME,
    VECTOR,
    MachineReplay,
    Numbers,
    SharedMachines,
    received_words,
)
from cosim.analysis.replay.replay_result import (
    MessagesReplay,
    ProcessReplay,
    ReplayResult,
    difference,
    first_entry,
)
from cosim.record.rows import Rows, Slice
from cosim.record.run_record import RecordedRun, RunRecord
from netem.core.packet_rows import NETEM_PACKET
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    PLANT_ACTUATION,
    SENSOR_ACKNOWLEDGEMENT,
    SENSOR_MEASUREMENT,
    SETTINGS,
    direction_of,
)
from noack.protocol.roles import ENDS, LOOP_ROLES
from noack.protocol.wire_format import HEADER_ROW, MAGIC, Flow, datagram_bytes

_RECEIVED = {
    Flow.MEASUREMENT: SENSOR_MEASUREMENT,
    Flow.UPDATE: CONTROLLER_DELIVERY,
    Flow.ACTUATION: PLANT_ACTUATION,
    Flow.ACKNOWLEDGEMENT: SENSOR_ACKNOWLEDGEMENT,
}
"""The table of the last receiver of each flow."""
_CONTENT, _SENT, _FORWARDED = "content", "sent", "forwarded"
"""Kinds of differences."""


class MessageComparison:
    """Compares the messages of every hop of the loop, part by part of the record."""

    def __init__(self, record: RunRecord, machines: Mapping[str, MachineReplay]) -> None:
        self._record, self._machines = record, machines
        network = record.scenario.network.flows
        self._hops = [
            _HopComparison(name, table, machines[ENDS[flow].sender], flow, record.number, network)
            for name, table, flow in _hops(network)
        ]

    def take(self, part: Slice) -> None:
        """Compare the messages of a part that the machines have just replayed."""
        netem = self._machines.get("netem")
        if netem is None:  # a loop's network is replayed with that of the other loops
            packets = part[NETEM_PACKET][part[NETEM_PACKET]["release_ns"] >= 0]
            forwarded = [(packets["flow"], packets["head"])]
        else:
            forwarded = [] if netem.newest is None else [netem.newest.forwarded()]
        survivors = [(flows, headers_of(heads)) for flows, heads in forwarded]
        for hop in self._hops:
            hop.take(part, survivors)

    def results(self) -> tuple[MessagesReplay, ...]:
        """Return the result of each hop after the last part."""
        netem = self._machines.get("netem")
        # A killed emulator may have forwarded messages whose rows are missing.
        is_complete = self._record.is_complete("netem") if netem is None else netem.result.is_complete
        results = [hop.result(network_is_complete=is_complete) for hop in self._hops]
        return (*results, *_compare_changes(self._record))


def _hops(network: Sequence[Flow]) -> Iterator[tuple[str, str, Flow]]:
    """Yield the name of each hop, the receiver's table, and the flow."""
    for flow, table in _RECEIVED.items():
        sender, receiver = ENDS[flow]
        if flow in network:
            yield f"{sender} → netem", NETEM_PACKET, flow
            yield f"netem → {receiver}", table, flow
        elif flow is not Flow.ACKNOWLEDGEMENT:
            yield f"{sender} → {receiver}", table, flow


def _compare_changes(record: RunRecord) -> Iterator[MessagesReplay]:
    """Compare the changes that the processes received, if there were any."""
    received_first: dict[int, tuple[object, ...]] = {}
    compared, first = 0, None
    for table in SETTINGS:
        for index, row in enumerate(record[table]):
            number = int(row["sequence"])
            change = (int(row["t_ns"]), row["change"].tobytes())
            compared += number in received_first
            known = received_first.setdefault(number, change)
            for column, value, other in zip(("t_ns", "change"), change, known, strict=True):
                if value != other and first is None:
                    at_ns, text = int(row["now_ns"]), "another process received another change"
                    first = difference(table, index, at_ns, text, column, value, other)
    received = sum(len(record[table]) for table in SETTINGS)
    if received:
        yield MessagesReplay(hop="coordinator → all", received=received, compared=compared, difference=first)


def headers_of(heads: NDArray[np.void]) -> Rows:
    """Return the headers in the first bytes of datagrams."""
    return np.ascontiguousarray(heads).view(HEADER_ROW)


def first_bytes(headers: Rows) -> NDArray[np.uint8]:
    """Return the bytes of headers, (k, 32)."""
    return headers.view(np.uint8).reshape(len(headers), HEADER_ROW.itemsize)


class _Difference(NamedTuple):
    """The first difference of one kind."""

    row: int
    """Number of the message among those of the hop."""
    table_row: int
    """Row of the table."""
    now_ns: int
    what: str
    column: str
    recorded: object
    replayed: object


class _HopComparison:
    """The messages of one hop, as received in the run and as sent in the replay."""

    def __init__(
        self,
        name: str,
        table: str,
        sender: MachineReplay,
        flow: Flow,
        loop: int,
        network: Sequence[Flow],
    ) -> None:
        self._name, self._table, self._sender, self._flow = name, table, sender, flow
        self._loop = loop
        self._direction = direction_of(flow)
        self._selects = table == NETEM_PACKET and len(network) > 1
        self._was_forwarded = table != NETEM_PACKET and flow in network
        self._sent: Numbers = np.zeros((0, VECTOR + 1), np.int64)
        """Messages that may still be received, in order of their numbers, (k, 3 + n)."""
        self._survivors: set[int] = set()
        self._waiting: Rows | None = None
        self._newest = -1
        self._received = self._read = 0
        self._run: tuple[int, int] | None = None
        """Version and run number of the datagrams."""
        self._compared = 0
        # Whether a message that was not sent, or not forwarded, is a difference is known at the
        # end: then it is known whether the replay covers all messages.
        self._first: dict[str, _Difference] = {}

    def take(self, part: Slice, survivors: list[tuple[Numbers, Rows]]) -> None:
        """Add the messages sent in a part, and compare those received in the part before.

        By its receiver's clock, a message may be received before it was sent by its sender's, if
        they are on different hosts, and so in the part before.
        """
        if self._sender.newest is not None:
            self._add(self._sender.newest.sent_in(self._flow))
        if self._was_forwarded:
            for flows, headers in survivors:
                own_headers = headers[(flows == self._direction) & (headers["magic"] == MAGIC)]
                self._survivors.update(own_headers["sequence"].tolist())
        self._compare_waiting()
        self._waiting = part[self._table]

    def _compare_waiting(self) -> None:
        """Compare the messages received in the part before."""
        rows, self._waiting = self._waiting, None
        if rows is None:
            return
        self._rows, self._at = rows, np.arange(len(rows))
        if self._selects:
            self._at = np.flatnonzero(rows["flow"] == self._direction)
            self._rows = rows[self._at]
        if self._table == NETEM_PACKET:
            self._compare_heads()
            if not self._selects:
                self._compare_flows()
        else:
            self._compare_vectors()
        if self._was_forwarded:
            self._compare_with_survivors()
        self._received += len(self._rows)
        self._read += len(rows)
        # Every receiver accepts only messages that are newer than those before.
        first = int(np.searchsorted(self._sent[:, SEQUENCE], self._newest))
        self._sent = self._sent[first:]
        self._survivors = {k for k in self._survivors if k >= self._newest}

    def result(self, *, network_is_complete: bool) -> MessagesReplay:
        """Return the first difference of all messages, after the last part."""
        self._compare_waiting()
        counts = {_SENT: self._sender.result.is_complete, _FORWARDED: network_is_complete}
        kinds = [kind for kind in (_CONTENT, _SENT, _FORWARDED) if counts.get(kind, True)]
        firsts = [self._first[kind] for kind in kinds if kind in self._first]
        first, first_difference = min(firsts, key=lambda difference: difference.row, default=None), None
        if first is not None:
            first_difference = difference(self._table, *first[1:])
        return MessagesReplay(
            hop=self._name, received=self._received, compared=self._compared, difference=first_difference
        )

    def _add(self, sent: Numbers) -> None:
        """Add messages; of several with the same number, the last one counts."""
        if len(self._sent):
            sent = np.concatenate([self._sent, sent])
        if (np.diff(sent[:, SEQUENCE]) < 0).any():
            sent = sent[np.argsort(sent[:, SEQUENCE], kind="stable")]
        self._sent = sent

    def _sent_rows(self, sequences: Numbers) -> tuple[Numbers, NDArray[np.bool_]]:
        """Return the row of each received number among the sent ones, and whether it is there."""
        sent = np.append(self._sent[:, SEQUENCE], 0)
        sent_rows = np.searchsorted(sent[:-1], sequences, "right") - 1
        return sent_rows, (sent_rows >= 0) & (sent[sent_rows] == sequences)

    def _compare_vectors(self) -> None:
        """Compare sequence number, time and vector of the received messages."""
        words, entries = received_words(self._table, self._rows)
        numbers = words[:, SEQUENCE]
        newest = np.maximum.accumulate(np.append(self._newest, numbers))
        self._newest = int(newest[-1])
        last = int(np.searchsorted(self._sent[:, SEQUENCE], self._newest, "right"))
        in_turn = self._sent[max(last - len(words), 0) : last, :-1]
        if (np.diff(newest) > 0).all() and np.array_equal(words, in_turn):  # nothing was lost
            self._compared += len(words)
            return
        sent_rows, known = self._sent_rows(numbers)
        self._compared += int(known.sum())
        is_newer, sent = numbers > newest[:-1], self._sent[sent_rows, :-1] if known.any() else words
        if known.all() and is_newer.all() and (words == sent).all():
            return
        for row in np.flatnonzero(~(known & is_newer & (words == sent).all(axis=1))).tolist():
            sequence, t_ns = words[row, :VECTOR].tolist()
            if not is_newer[row]:
                self._note_difference(row, "not newer than the message before", "sequence", sequence)
            if not known[row]:
                kind = _CONTENT if sequence < 0 else _SENT
                self._note_difference(row, "was never sent", "sequence", sequence, kind=kind)
            elif t_ns != (sent_ns := int(sent[row, TIME])):
                self._note_difference(row, "differs from the message sent", "t_ns", t_ns, sent_ns)
            elif entry := first_entry(*(of[row, VECTOR:].view(np.float64) for of in (words, sent))):
                index, *values = entry
                self._note_difference(row, "differs from the message sent", entries[index], *values)

    def _compare_heads(self) -> None:
        """Compare the part of a datagram that netem records: its first bytes and its size."""
        headers, sizes = headers_of(self._rows["head"]), self._rows["size_bytes"]
        is_valid = headers["magic"] == MAGIC
        if self._run is None and is_valid.any():
            # The run number is random and recorded only here.
            counts = Counter(headers[is_valid][["version", "run_id"]].tolist())
            self._run = max(sorted(counts), key=counts.__getitem__)
        sequences = np.where(is_valid, headers["sequence"].view(np.int64), -1)
        self._newest = int(max(self._newest, sequences.max(initial=-1)))
        sent_rows, known = self._sent_rows(sequences)
        self._compared += int(known.sum())
        entries = self._sent.shape[1] - VECTOR - 1
        expected, sent = np.zeros(len(headers), HEADER_ROW), self._sent[sent_rows[known]]
        if known.any():
            own = expected[known]
            own["magic"], own["flow"] = MAGIC, self._flow
            own["dimension"], own["loop"] = entries, self._loop
            own["version"], own["run_id"] = self._run or (0, 0)
            own["sequence"], own["t_ns"], own["error_level"] = sent[:, SEQUENCE], sent[:, TIME], sent[:, -1]
            expected[known] = own
        size_bytes = datagram_bytes(entries)
        differs = first_bytes(headers) != first_bytes(expected)
        for row in np.flatnonzero(differs.any(axis=1) | (sizes != size_bytes)).tolist():
            head, size = self._rows["head"][row].tobytes(), int(sizes[row])
            description = "differs from the message sent"
            if not known[row]:
                kind = _CONTENT if sequences[row] < 0 else _SENT
                self._note_difference(row, "was never sent", "head", head, kind=kind)
            elif differs[row].any():
                self._note_difference(row, description, "head", head, expected[row].tobytes())
            else:
                self._note_difference(row, description, "size_bytes", size, size_bytes)

    def _compare_flows(self) -> None:
        """Check that only the sensor's flow was forwarded."""
        for row, flow in enumerate(self._rows["flow"].tolist()):
            if flow != 0:
                self._note_difference(row, "netem serves only the sensor's flow", "flow", flow, 0)

    def _compare_with_survivors(self) -> None:
        """Check that the network forwarded every received message."""
        for row, sequence in enumerate(self._rows["sequence"].tolist()):
            if sequence not in self._survivors:
                description = "netem did not forward it"
                self._note_difference(row, description, "sequence", sequence, kind=_FORWARDED)

    def _note_difference(
        self,
        row: int,
        description: str,
        column: str,
        recorded: object,
        replayed: object = None,
        *,
        kind: str = _CONTENT,
    ) -> None:
        known = self._first.get(kind)
        if known is None or self._received + row < known.row:
            row_read, now_ns = self._read + int(self._at[row]), int(self._rows["now_ns"][row])
            self._first[kind] = _Difference(
                self._received + row, row_read, now_ns, description, column, recorded, replayed
            )


Result = TypeVar("Result", ProcessReplay, MessagesReplay)


def replay(record: RunRecord, shared: SharedMachines | None = None) -> ReplayResult:
    """Replay a run and compare it with its record; a process is replayed up to its first gap.

    ``shared`` has the machines of several loops, if they are replayed in turn.

    In a run of several loops, or of one that begins later than the run, the network is replayed
    once, in the time of the run: ``record`` is that of the network, or that of a loop, whose
    network is not replayed. The record is read part by part, so that memory does not grow with the
    length of the run.
    """
    shared = shared or SharedMachines(())
    machines = {role: MachineReplay(role, record, shared) for role in record.roles}
    messages = MessageComparison(record, machines) if "sensor" in machines else None
    with np.errstate(all="ignore"):  # a diverging run overflows and is replayed all the same
        for part in record.slices():
            for machine in machines.values():
                machine.take(part)
            if messages is not None:
                messages.take(part)
    results = tuple(machine.result for machine in machines.values())
    return ReplayResult(processes=results, messages=() if messages is None else messages.results())


def replay_run(run: RecordedRun, loop: str | None = None) -> ReplayResult:
    """Replay a run, or one of its loops; the results of each process and each hop are added up.

    Raises:
        CallerError: there is no such loop.
    """
    if loop is not None or not run.has_own_network:
        return replay(run.loop(loop))
    replays = [replay(run.network), *map(replay, run.loops)]
    processes = _by_name((result.process, result) for replayed in replays for result in replayed.processes)
    messages = _by_name((result.hop, result) for replayed in replays for result in replayed.messages)
    in_order = sorted(processes, key=LOOP_ROLES.index)
    return ReplayResult(
        processes=tuple(_add_up(processes[name]) for name in in_order),
        messages=tuple(map(_add_up, messages.values())),
    )


def _by_name(named: Iterable[tuple[str, Result]]) -> dict[str, list[Result]]:
    by_name: dict[str, list[Result]] = {}
    for name, result in named:
        by_name.setdefault(name, []).append(result)
    return by_name


def _add_up(results: Sequence[Result]) -> Result:
    """Return the results of a process, or of a hop, of all loops as one."""
    differences = filter(None, (result.difference for result in results))
    sums = {"inputs", "compared", "received"} & vars(results[0]).keys()
    update: dict[str, object] = {name: sum(getattr(result, name) for result in results) for name in sums}
    update["difference"] = min(differences, key=lambda difference: difference.now_ns, default=None)
    if isinstance(results[0], ProcessReplay):
        missing = (result.missing_from for result in results if result.missing_from is not None)
        update["missing_from"] = next(missing, None)
        update["end_known"] = all(result.end_known for result in results)
    return results[0].model_copy(update=update)
