"""Cost per call of the plant, the wire format and the telemetry buffer.

Each is compared with a simple alternative: pickle with HMAC, JSON, a general integrator. Both sides
make the same calls on the same inputs, in turn.
"""

import argparse
import gc
import hashlib
import hmac
import json
import pickle
import time
from collections.abc import Callable, Iterable
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from benchmarks._report import Benchmark, Peer, Row, median, say
from cosim.cli import find_scenario
from noack.config.resolution import LoopMatrices, loop_of, resolve
from noack.config.scenario import Scenario
from noack.config.scenario_file import load
from noack.core.linear_systems import Vector
from noack.protocol.machine_interface import Record
from noack.protocol.record_tables import PLANT_STEP, tables
from noack.protocol.wire_format import Decoder, Encoder, Flow, Message
from noack.runtime.telemetry import TelemetryBuffer
from plant_server.plant import plant_of

ROUNDS = 9
CALLS = 400
_SHA256_BYTES = 32

Batch = Callable[[], object]
"""Makes CALLS calls."""


class Case(NamedTuple):
    """Two sides to compare; each is set up again for each round, outside the timing."""

    name: str
    ours: Callable[[], Batch]
    peer_name: str
    peer: Callable[[], Batch]


class Inputs:
    """The inputs of all cases: the paper's loop and a series of its measurements."""

    def __init__(self) -> None:
        self.scenario: Scenario = resolve(load(find_scenario("lane_following"), ()))
        self.loop: LoopMatrices = loop_of(self.scenario)
        self.period_ns = self.scenario.timing.plant_period_ns
        self.period_s = self.period_ns * 1e-9
        self.key = bytes(range(32))
        self.measurements: list[Message] = []
        self.rows: list[Record] = []
        plant = plant_of(self.scenario)
        for step in range(CALLS):
            for output in plant.on_timer(step * self.period_ns):
                if isinstance(output, Message):
                    self.measurements.append(output)
                elif isinstance(output, Record):
                    self.rows.append(output)


def each(calls: Callable[..., object], *inputs: Iterable[object]) -> Batch:
    """Return a batch that calls ``calls`` with each of the inputs."""
    tuples = list(zip(*inputs, strict=True))

    def batch() -> None:
        for arguments in tuples:
            calls(*arguments)

    return batch


def pickled(key: bytes, message: Message) -> bytes:
    """Return a message as a pickle, tagged with HMAC-SHA-256."""
    content = pickle.dumps(tuple(message), pickle.HIGHEST_PROTOCOL)
    return content + hmac.digest(key, content, hashlib.sha256)


def unpickled(key: bytes, datagram: bytes) -> Message:
    """Return the message of a datagram of :func:`pickled`.

    Raises:
        ValueError: the tag is wrong.
    """
    content, tag = datagram[:-_SHA256_BYTES], datagram[-_SHA256_BYTES:]
    if not hmac.compare_digest(hmac.digest(key, content, hashlib.sha256), tag):
        raise ValueError("wrong tag")
    return Message(*pickle.loads(content))


def wire_cases(inputs: Inputs) -> list[Case]:
    """Encode and decode authenticated datagrams, compared with pickle with HMAC-SHA-256."""
    key, messages = inputs.key, inputs.measurements
    encoder = Encoder(1, key)
    ours = [encoder.encode(message) for message in messages]
    theirs = [pickled(key, message) for message in messages]
    n = inputs.loop.n
    return [
        Case("wire encode", lambda: each(encoder.encode, messages),
             "pickle + HMAC-SHA-256", lambda: each(partial(pickled, key), messages)),
        Case("wire decode", lambda: each(Decoder(Flow.MEASUREMENT, n, 1, key).decode, ours),
             "pickle + HMAC-SHA-256", lambda: each(partial(unpickled, key), theirs)),
    ]  # fmt: skip


def telemetry_case(inputs: Inputs) -> Case:
    """Add a row to the record's buffer, including batches, compared with a list written as JSON."""
    loop = inputs.loop
    table = {PLANT_STEP: tables(loop.n, loop.m)[PLANT_STEP]}

    def ours() -> Batch:
        buffer = TelemetryBuffer(table, lambda table, header, payload: None)
        rows = inputs.rows

        def batch() -> None:
            for row in rows:
                buffer.append(row)
            buffer.flush()

        return batch

    def peer() -> Batch:
        gathered: list[tuple[object, ...]] = []
        rows = inputs.rows

        def batch() -> None:
            for row in rows:
                gathered.append(row.row)  # noqa: PERF401 - one by one, like the other side
            json.dumps(gathered, default=np.ndarray.tolist).encode()

        return batch

    return Case("telemetry append", ours, "list append, then json.dumps", peer)


def plant_case(inputs: Inputs) -> Case:
    """A step of the plant, compared with a general integrator."""
    loop, h_s, u = inputs.loop, inputs.period_s, np.zeros(inputs.loop.m)
    states = [message.vector for message in inputs.measurements]
    steps = [k * inputs.period_ns for k in range(CALLS)]

    def integrated(x: Vector) -> object:
        return solve_ivp(lambda t, z: loop.A @ z + loop.B @ u, (0.0, h_s), x, rtol=1e-9).y[:, -1]

    return Case("plant step", lambda: each(plant_of(inputs.scenario).on_timer, steps),
                "scipy's solve_ivp, RK45", lambda: each(integrated, states))  # fmt: skip


def cases(inputs: Inputs) -> list[Case]:
    """All cases."""
    return [plant_case(inputs), *wire_cases(inputs), telemetry_case(inputs)]


def per_call_us(batch: Batch) -> float:
    """Return wall microseconds per call of a batch of CALLS calls."""
    begun_ns = time.perf_counter_ns()
    batch()
    return (time.perf_counter_ns() - begun_ns) / CALLS / 1e3


def compare(case: Case, rounds: int = ROUNDS) -> Row:
    """Time both sides of a case in turn; return the row of their medians."""
    ours, peers = [], []
    gc.collect()
    gc.disable()
    try:
        for _ in range(rounds):
            ours.append(per_call_us(case.ours()))
            peers.append(per_call_us(case.peer()))
    finally:
        gc.enable()
    return Row(case.name, median(ours), "µs/call", Peer(case.peer_name, median(peers)))


def measure(options: argparse.Namespace) -> list[Row]:
    """Compare all cases."""
    rows = []
    for case in cases(Inputs()):
        say(case.name)
        rows.append(compare(case))
    return rows


BENCHMARK = Benchmark("machines", "Cost per call", measure)
