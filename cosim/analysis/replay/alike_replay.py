"""Replays loops in turn, whose machines are made at once.

This finds out whether all rows and messages of a loop are equal, as they are in almost every run.
If one of them is not, the loop is replayed alone, which finds and explains the first difference.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress

import numpy as np

from cosim.analysis.replay.machine_replay import (
    DAMAGE,
    SEQUENCE,
    TIME,
    VECTOR,
    InputReplay,
    Numbers,
    machines_of,
    received_words,
    sent_sizes,
)
from cosim.analysis.replay.run_replay import headers_of, hops
from cosim.analysis.summary_model import ReplayPart
from cosim.record.record_source import Rows
from cosim.record.run_record import RunRecord
from noack.machines.loop_machines import LoopMachines
from noack.protocol.machine_interface import Start
from noack.protocol.record_tables import NETEM_PACKET, SETTINGS, direction_of
from noack.protocol.wire_format import HEADER_ROW, MAGIC, Flow, datagram_bytes


class _OtherError(Exception):
    """Something is not equal, or not as in almost every run."""


def _require(holds: bool | np.bool_) -> None:
    if not holds:
        raise _OtherError


@np.errstate(all="ignore")  # a diverging run overflows and is replayed all the same
def replay_in_turn(records: Sequence[RunRecord]) -> Mapping[RunRecord, ReplayPart]:
    """Return the results of the loops that are complete, and replayed without a difference.

    The rows of the loops are in memory.
    """
    found: dict[RunRecord, ReplayPart] = {}
    loops = [one for one in records if one.is_short and not any(map(one.count, SETTINGS))]
    with suppress(*DAMAGE):
        scenarios = [one.scenario for one in loops]
        machines = {role: machines_of(role, scenarios, Start(0)) for role in loops[0].roles}
        for place, record in enumerate(loops):
            with suppress(_OtherError, *DAMAGE):
                found[record] = _replayed(record, place, machines)
    return found


def _replayed(record: RunRecord, place: int, machines: Mapping[str, LoopMachines]) -> ReplayPart:
    """Replay a loop by the machines at a place."""
    sent, inputs = dict[Flow, Numbers](), 0
    for role, own in machines.items():
        _require(record.is_complete(role))
        rows = {table: record[table] for table in record.owned_by(role)}
        numbers = np.concatenate([one["input"] for one in rows.values()])
        order = np.argsort(numbers, kind="stable")
        _require(np.array_equal(numbers[order], np.arange(len(order))))
        sizes = sent_sizes(role, record.scenario)
        one = InputReplay(role, own, sizes, place)
        _require(one.replay(rows, order, dict.fromkeys(rows, 0)) == len(order) and one.difference is None)
        sent |= {flow: one.sent_in(flow) for flow in sizes}
        inputs += len(order)
    _require(inputs > 0)
    flows, packets = record.scenario.network.flows, record[NETEM_PACKET]
    for _, table, flow in hops(flows):
        if table != NETEM_PACKET:
            _compare_vectors(table, record[table], sent[flow], packets if flow in flows else None, flow)
        elif len(flows) == 1:
            _compare_heads(packets, sent[flow], flow, record.number)
        else:
            mine = packets["flow"] == direction_of(flow)
            _compare_heads(packets.compress(mine), sent[flow], flow, record.number)
    return ReplayPart(bit_exact=True, inputs=inputs)


def _places(sent: Numbers, sequences: Numbers) -> Numbers:
    """Return the places of received messages among the sent ones."""
    places = np.searchsorted(sent[:, SEQUENCE], sequences)
    _require(np.array_equal(np.append(sent[:, SEQUENCE], -1)[places], sequences))
    return places


def _compare_vectors(table: str, rows: Rows, sent: Numbers, packets: Rows | None, flow: Flow) -> None:
    """Compare the messages that a process received; some have crossed the network."""
    words, _ = received_words(table, rows)
    _require((np.diff(sent[:, SEQUENCE]) > 0).all())
    if not np.array_equal(words, sent[: len(words), :-1]):
        _require((np.diff(words[:, SEQUENCE]) > 0).all())
        _require(np.array_equal(words, sent[_places(sent, words[:, SEQUENCE]), :-1]))
    if packets is not None:
        headers, passed = headers_of(packets["head"]), packets["release_ns"] >= 0
        passed &= (headers["magic"] == MAGIC) & (packets["flow"] == direction_of(flow))
        _require({*words[:, SEQUENCE].tolist()} <= {*headers["sequence"][passed].tolist()})


def _compare_heads(packets: Rows, sent: Numbers, flow: Flow, loop: int) -> None:
    """Compare what the network recorded of the messages of a flow: first bytes, and sizes."""
    headers, expected = headers_of(packets["head"]), np.zeros(len(packets), HEADER_ROW)
    entries = sent.shape[1] - VECTOR - 1
    if len(headers):
        words = sent[_places(sent, headers["sequence"].view(np.int64))]
        expected["magic"], expected["flow"], expected["loop"] = MAGIC, flow, loop
        expected["dimension"] = entries
        expected["version"], expected["run_id"] = headers[0]["version"], headers[0]["run_id"]
        expected["sequence"], expected["t_ns"] = words[:, SEQUENCE], words[:, TIME]
        expected["error_level"] = words[:, -1]
    _require((packets["flow"] == direction_of(flow)).all())
    _require((packets["size_bytes"] == datagram_bytes(entries)).all())
    _require(headers.tobytes() == expected.tobytes())
