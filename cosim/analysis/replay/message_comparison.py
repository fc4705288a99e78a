"""Compares the messages that a process sends in its replay with those that the next one received.

Every received message must be bit-identical to a sent one. Messages that were lost in the network
are not compared.
"""

from collections import Counter
from collections.abc import Iterator, Mapping

import numpy as np

from cosim.analysis.replay.machine_replay import MachineReplay, received_vectors
from cosim.analysis.replay.replay_result import MessagesReplay, difference, first_entry
from cosim.record.run_record import Rows, RunRecord
from noack.protocol.record_tables import (
    ACKNOWLEDGEMENTS,
    CONTROLLER_DELIVERY,
    NETEM_PACKET,
    PACKET_HEAD_BYTES,
    PLANT_ACTUATION,
    SENSOR_ACKNOWLEDGEMENT,
    SENSOR_MEASUREMENT,
    SETTINGS,
    UPDATES,
)
from noack.protocol.wire_format import KEY_BYTES, Encoder, Flow, Message, read_header

_HOPS = (
    ("plant → sensor", SENSOR_MEASUREMENT, "plant", Flow.MEASUREMENT),
    ("sensor → netem", NETEM_PACKET, "sensor", Flow.UPDATE),
    ("netem → controller", CONTROLLER_DELIVERY, "sensor", Flow.UPDATE),
    ("controller → plant", PLANT_ACTUATION, "controller", Flow.ACTUATION),
    ("controller → netem", NETEM_PACKET, "controller", Flow.ACKNOWLEDGEMENT),
    ("netem → sensor", SENSOR_ACKNOWLEDGEMENT, "controller", Flow.ACKNOWLEDGEMENT),
)
"""Name, the receiver's table, the process that made the messages, and their kind."""


def check_messages(
    record: RunRecord, replayed: Mapping[str, MachineReplay]
) -> tuple[MessagesReplay, ...]:
    """Compare the messages of every hop of the loop."""
    acknowledges = SENSOR_ACKNOWLEDGEMENT in record.tables
    found = []
    for leg, table, sender, flow in _HOPS:
        if flow is Flow.ACKNOWLEDGEMENT and not acknowledges:
            continue
        hop = _Received(leg, table, record, replayed[sender], flow)
        if table == NETEM_PACKET:
            hop.compare_heads()
            if not acknowledges:
                hop.compare_flows()
        else:
            hop.compare_vectors()
        if table in (CONTROLLER_DELIVERY, SENSOR_ACKNOWLEDGEMENT):
            hop.compare_with_survivors(replayed["netem"])
        found.append(hop.result())
    return (*found, *_compare_changes(record))


def _compare_changes(record: RunRecord) -> Iterator[MessagesReplay]:
    """Compare the changes that the processes received, if there were any."""
    first: dict[int, tuple[object, ...]] = {}
    compared, found = 0, None
    for table in SETTINGS:
        for place, row in enumerate(record[table]):
            number = int(row["sequence"])
            change = (int(row["t_ns"]), row["change"].tobytes())
            compared += number in first
            known = first.setdefault(number, change)
            for column, one, other in zip(("t_ns", "change"), change, known, strict=True):
                if one != other and found is None:
                    what = "another process received another change"
                    found = difference(table, place, int(row["now_ns"]), what, column, one, other)
    received = sum(len(record[table]) for table in SETTINGS)
    if received:
        yield MessagesReplay(
            leg="coordinator → all", received=received, compared=compared, difference=found
        )


class _Received:
    """The messages of one hop, as received in the run and as sent in the replay."""

    def __init__(
        self, leg: str, table: str, record: RunRecord, sender: MachineReplay, flow: Flow
    ) -> None:
        self._leg = leg
        self._table = table
        self._rows: Rows = record[table]
        self._at = np.arange(len(self._rows))
        self._direction = ACKNOWLEDGEMENTS if flow is Flow.ACKNOWLEDGEMENT else UPDATES
        if table == NETEM_PACKET and record.scenario.protocol.acknowledges:
            self._at = np.flatnonzero(self._rows["flow"] == self._direction)
            self._rows = self._rows[self._at]
        self._sent: dict[int, Message] = {
            message.sequence: message for message in sender.sent if message.flow is flow
        }
        self._all_sent = sender.whole
        self._compared = 0
        self._first: tuple[int, str, str, object, object] | None = None

    def result(self) -> MessagesReplay:
        found = None
        if self._first is not None:
            row, what, column, recorded, replayed = self._first
            now_ns, place = int(self._rows["now_ns"][row]), int(self._at[row])
            found = difference(self._table, place, now_ns, what, column, recorded, replayed)
        return MessagesReplay(
            leg=self._leg, received=len(self._rows), compared=self._compared, difference=found
        )

    def compare_vectors(self) -> None:
        """Compare sequence number, time and vector of the received messages."""
        rows, newest = self._rows, -1
        vectors, entries = received_vectors(self._table, rows)
        fields = (rows["sequence"].tolist(), rows["t_ns"].tolist(), vectors)
        for row, (sequence, t_ns, vector) in enumerate(zip(*fields, strict=True)):
            if sequence <= newest:
                self._differs(row, "not newer than the message before", "sequence", sequence)
            newest = max(newest, sequence)
            message = self._find(row, sequence, "sequence", sequence)
            if message is None:
                continue
            if t_ns != message.t_ns:
                self._differs(row, "differs from the message sent", "t_ns", t_ns, message.t_ns)
            elif vector.tobytes() != message.vector.tobytes() and (
                entry := first_entry(vector, message.vector)
            ):
                place, *values = entry
                self._differs(row, "differs from the message sent", entries[place], *values)

    def compare_heads(self) -> None:
        """Compare the part of a datagram that netem records: its first bytes and its size."""
        heads, sizes = self._rows["head"].tolist(), self._rows["size_bytes"].tolist()
        headers = [read_header(head) for head in heads]
        # The run number is random and recorded only here.
        ids = Counter(header.run_id for header in headers if header is not None)
        encoder = Encoder(ids.most_common(1)[0][0] if ids else 0, bytes(KEY_BYTES))
        for row, (head, size, header) in enumerate(zip(heads, sizes, headers, strict=True)):
            message = self._find(row, -1 if header is None else header.sequence, "head", head)
            if message is None:
                continue
            data = encoder.encode(message)
            expected = data[:PACKET_HEAD_BYTES].ljust(PACKET_HEAD_BYTES, b"\0")
            if head != expected:
                self._differs(row, "differs from the message sent", "head", head, expected)
            elif size != len(data):
                self._differs(row, "differs from the message sent", "size_bytes", size, len(data))

    def compare_flows(self) -> None:
        """Check that only the sensor's flow was forwarded."""
        for row, flow in enumerate(self._rows["flow"].tolist()):
            if flow != 0:
                self._differs(row, "netem serves only the sensor's flow", "flow", flow, 0)

    def compare_with_survivors(self, network: MachineReplay) -> None:
        """Check that the network forwarded every received message."""
        if not network.whole:
            return
        survivors = {
            header.sequence
            for datagram in network.sent
            if datagram.flow == self._direction and (header := read_header(datagram.data))
        }
        for row, sequence in enumerate(self._rows["sequence"].tolist()):
            if sequence not in survivors:
                self._differs(row, "netem did not forward it", "sequence", sequence)

    def _find(self, row: int, sequence: int, column: str, value: object) -> Message | None:
        """Return the message of a number if its sender was replayed that far and sent it."""
        if (message := self._sent.get(sequence)) is not None:
            self._compared += 1
            return message
        if sequence < 0 or self._all_sent:
            self._differs(row, "was never sent", column, value)
        return None

    def _differs(
        self, row: int, what: str, column: str, recorded: object, replayed: object = None
    ) -> None:
        if self._first is None or row < self._first[0]:
            self._first = (row, what, column, recorded, replayed)
