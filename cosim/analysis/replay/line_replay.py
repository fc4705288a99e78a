"""Replays like loops together: the machines of a role, and then the messages of each hop, at once.

This finds out whether all rows and messages are equal, as they are in almost every run. If one of
them is not, each loop is replayed alone, which finds and explains its first difference.
"""

from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

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
from cosim.record.loop_line import SPAN, LoopLine, lines_of
from cosim.record.run_record import RunRecord
from noack.protocol.machine_interface import Start
from noack.protocol.record_tables import NETEM_PACKET, direction_of
from noack.protocol.wire_format import HEADER_ROW, MAGIC, Flow, datagram_bytes


class _OtherError(Exception):
    """Something is not equal, or not as in almost every run."""


class _Sent(NamedTuple):
    """The messages of a flow that the machines of a line sent, loop after loop."""

    words: Numbers
    """(k, 2 + n)"""
    keys: Numbers
    """Their numbers, which no other loop has, (k,)."""

    def at(self, keys: Numbers) -> Numbers:
        """Return the places of messages."""
        places = np.searchsorted(self.keys, keys)
        _require(np.array_equal(np.append(self.keys, -1)[places], keys))
        return places


def _require(holds: bool | np.bool_) -> None:
    if not holds:
        raise _OtherError


def replay_together(records: Sequence[RunRecord]) -> dict[RunRecord, ReplayPart]:
    """Return the results of the loops that are complete, and replayed without a difference."""
    found: dict[RunRecord, ReplayPart] = {}
    for line in lines_of(records):
        with suppress(_OtherError, ValueError, *DAMAGE):
            inputs = _inputs(line)
            results = (ReplayPart(bit_exact=True, complete=True, inputs=count) for count in inputs)
            found |= zip(line.records, results, strict=True)
    return found


@np.errstate(all="ignore")  # a diverging run overflows and is replayed all the same
def _inputs(line: LoopLine) -> list[int]:
    """Return the number of replayed inputs of each loop, if all is equal."""
    roles = line.records[0].roles
    _require(all(record.is_complete(role) for record in line.records for role in roles))
    sent: dict[Flow, _Sent] = {}
    inputs = np.zeros(len(line.records), np.int64)
    for role in roles:
        counts, messages = _replayed(line, role)
        inputs, sent = inputs + counts, sent | messages
    network = line.scenario.network.flows
    for _, table, flow in hops(network):
        if table == NETEM_PACKET:
            _compare_heads(line, flow, sent[flow])
        else:
            _compare_vectors(line, table, sent[flow], direction_of(flow) if flow in network else None)
    _require((inputs > 0).all())
    return inputs.tolist()


def _replayed(line: LoopLine, role: str) -> tuple[Numbers, dict[Flow, _Sent]]:
    """Replay the machines of a role; return the numbers of their inputs, and what they sent."""
    tables, loops = line.records[0].owned_by(role), len(line.records)
    inputs = np.concatenate([line.numbers(table, "input") for table in tables])
    order, counts = np.argsort(inputs, kind="stable"), [np.diff(line.starts(table)) for table in tables]
    begins = np.append(0, np.cumsum(sum(counts)))
    in_turn = np.arange(len(inputs)) + np.repeat(np.arange(loops) * SPAN - begins[:-1], np.diff(begins))
    _require(np.array_equal(inputs[order], in_turn))
    # The tables of all loops follow each other; those of a loop do so, too.
    places, before = [], np.zeros(loops, np.int64)
    for table, count in zip(tables, counts, strict=True):
        first = before - line.starts(table)[:-1]
        places.append(np.arange(count.sum()) + np.repeat(first, count))
        before = before + count
    places_in_order = np.concatenate(places)[order]
    sizes = sent_sizes(role, line.scenario)
    machines = machines_of(role, [record.scenario for record in line.records], Start(0))
    sent: dict[Flow, list[Numbers]] = {flow: [] for flow in sizes}
    for loop, (record, begin, end) in enumerate(zip(line.records, begins, begins[1:], strict=False)):
        one = InputReplay(role, machines, sizes, loop)
        rows = {table: record[table] for table in tables}
        taken = one.replay(rows, places_in_order[begin:end], dict.fromkeys(tables, 0))
        _require(taken == end - begin and one.difference is None)
        for flow, words in sent.items():
            words.append(one.sent_in(flow))
    return np.diff(begins), {flow: _sent(words) for flow, words in sent.items()}


def _sent(by_loop: Sequence[Numbers]) -> _Sent:
    words = np.concatenate(by_loop)
    loops = np.repeat(np.arange(len(by_loop)), [*map(len, by_loop)])
    keys = words[:, SEQUENCE] + loops * SPAN
    _require((np.diff(keys) > 0).all())
    return _Sent(words, keys)


def _compare_vectors(line: LoopLine, table: str, sent: _Sent, direction: int | None) -> None:
    """Compare the messages that a process received; they may have crossed the network."""
    keys = line.numbers(table, "sequence")
    words = np.concatenate([received_words(table, record[table])[0] for record in line.records])
    _require((np.diff(keys) > 0).all() and np.array_equal(sent.words[sent.at(keys)], words))
    if direction is not None:
        headers, flows = headers_of(line.column(NETEM_PACKET, "head")), line.column(NETEM_PACKET, "flow")
        passed = (line.column(NETEM_PACKET, "release_ns") >= 0) & (flows == direction)
        passed &= headers["magic"] == MAGIC
        passed_keys = headers["sequence"].view(np.int64) + line.shifts(NETEM_PACKET)
        _require(np.isin(keys, passed_keys[passed]).all())


def _compare_heads(line: LoopLine, flow: Flow, sent: _Sent) -> None:
    """Compare what the network recorded of the messages of a flow: first bytes, and sizes."""
    flows = line.column(NETEM_PACKET, "flow")
    mine = flows == direction_of(flow)
    _require(mine.all() or len(line.scenario.network.flows) > 1)
    headers = headers_of(line.column(NETEM_PACKET, "head"))[mine]
    expected = np.zeros(len(headers), HEADER_ROW)
    if len(headers):
        numbers = np.array([record.number for record in line.records])
        loops = line.shifts(NETEM_PACKET)[mine] // SPAN
        words = sent.words[sent.at(headers["sequence"].view(np.int64) + loops * SPAN)]
        expected["magic"], expected["flow"], expected["loop"] = MAGIC, flow, numbers[loops]
        expected["dimension"] = words.shape[1] - VECTOR
        expected["version"], expected["run_id"] = headers[0]["version"], headers[0]["run_id"]
        expected["sequence"], expected["t_ns"] = words[:, SEQUENCE], words[:, TIME]
    sizes = line.column(NETEM_PACKET, "size_bytes")[mine]
    _require((sizes == datagram_bytes(sent.words.shape[1] - VECTOR)).all())
    _require(headers.tobytes() == expected.tobytes())
