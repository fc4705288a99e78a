"""The live driver does with sockets what the machines do one input at a time.

It also runs with a core that has sanitizers (tests/native/test_sanitized.py).
"""

import errno
import os
import socket
import struct
from collections.abc import Sequence
from contextlib import closing
from hashlib import blake2b
from typing import Any

import numpy as np
import pytest

from noack.core.core_library import core
from noack.protocol.record_tables import CONTROLLER_STEP, PLANT_STEP, SENSOR_MEASUREMENT
from noack.protocol.roles import Record
from noack.protocol.wire_format import TAG_BYTES, Flow, Message, Rejection
from noack.runtime.drivers.live_driver import LiveDriver
from tests.helpers.wire_decoder import NO_VECTOR
from tests.noack.runtime.drivers.live_loops import HOUR_NS, KEY, Live, measurement, plain, received, scenario

NOW = "now_ns"


def one_by_one(live: Live, inputs: Sequence[tuple[Message | None, int]]) -> tuple[Any, Any]:
    """Pass inputs, each with its time, to machines without a driver; return messages and rows."""
    sent, rows = [], []
    for message, now_ns in inputs:
        alone = live.alone
        for output in alone.on_timer(now_ns) if message is None else alone.handle(message, now_ns):
            if isinstance(output, Message):
                sent.append(live.encoder.encode(output))
            elif isinstance(output, Record):
                rows.append(plain(output.row))
    return sent, rows


def measurements(count: int, loops: int = 1) -> list[Message]:
    """Return measurements of an erratic state of each loop."""
    draw = np.random.default_rng(1)
    return [
        measurement(k + 1, draw.normal(size=2).tolist(), loop)
        for k in range(count) for loop in range(loops)
    ]  # fmt: skip


SO_NO_CHECK, UDP_SEGMENT, UDP_GRO = 11, 103, 104
DATAGRAM_BYTES = 32 + 2 * 8 + 16


@pytest.mark.sanitized
@pytest.mark.parametrize("together", [2, 40, 64])
def test_datagrams_that_the_kernel_passes_together_are_handled_one_by_one(
    content: dict[str, Any], together: int
) -> None:
    """More than the driver takes at once, the last message of each part shorter than others."""
    given = measurements(4, 50)
    with closing(Live("sensor", [scenario(content)] * 50)) as live:
        live.peer.connect(live.address)
        sizes = {len(live.encoder.encode(message)) for message in given}
        assert len(sizes) == 1
        head = [(socket.IPPROTO_UDP, UDP_SEGMENT, struct.pack("=H", *sizes))]
        for first in range(0, len(given), together):
            part = b"".join(map(live.encoder.encode, given[first : first + together]))
            live.peer.sendmsg([part + b"short"] if first else [part], head)
        live.drive_until_accepted(len(given))
        assert live.driver.core.sources[0].received == len(given) + len(range(together, len(given), together))
        rows = live.rows.tables[SENSOR_MEASUREMENT]
        assert [row[0] for row in rows] == [message.loop for message in given]


@pytest.mark.sanitized
@pytest.mark.parametrize("forged", range(10))
def test_a_forged_tag_among_others_is_rejected_alone(content: dict[str, Any], forged: int) -> None:
    """Four tags are compared at once; of ten datagrams, the last two are not among four."""
    with closing(Live("sensor", [scenario(content)] * 10)) as live:
        live.peer.connect(live.address)
        datagrams = [bytearray(live.encoder.encode(message)) for message in measurements(1, 10)]
        datagrams[forged][-1 - forged] ^= 1
        head = [(socket.IPPROTO_UDP, UDP_SEGMENT, struct.pack("=H", DATAGRAM_BYTES))]
        live.peer.sendmsg([b"".join(datagrams)], head)
        live.drive_until_accepted(9)
        assert live.driver.rejected[Rejection.TAG] == 1
        loops = [row[0] for row in live.rows.tables[SENSOR_MEASUREMENT]]
        assert loops == [loop for loop in range(10) if loop != forged]


@pytest.mark.sanitized
def test_messages_of_loops_that_tick_together_are_sent_together(content: dict[str, Any]) -> None:
    with closing(Live("plant", [scenario(content)] * 50, since_ns=HOUR_NS)) as live:
        live.peer.setsockopt(socket.IPPROTO_UDP, UDP_GRO, 1)
        live.drive(lambda: live.driver.core.sent >= 500)
        parts = received(live.peer, 65_536)
        assert max(map(len, parts)) == 64 * DATAGRAM_BYTES
        assert sum(map(len, parts)) == live.driver.core.sent * DATAGRAM_BYTES
        for datagram in np.frombuffer(b"".join(parts), np.uint8).reshape(-1, DATAGRAM_BYTES):
            tag = blake2b(datagram[:-TAG_BYTES], digest_size=TAG_BYTES, key=KEY).digest()
            assert bytes(datagram[-TAG_BYTES:]) == tag


@pytest.mark.sanitized
def test_they_are_sent_singly_if_the_kernel_refuses_to_segment(content: dict[str, Any]) -> None:
    """Linux refuses it on a socket that sends without checksums, on every interface."""
    # A tenth of a second late: what is sent at once fits into the peer's receive buffer.
    with closing(Live("plant", [scenario(content)] * 50, since_ns=100_000_000)) as live:
        with socket.socket(fileno=os.dup(live.driver.core.senders[0])) as sender:
            sender.setsockopt(socket.SOL_SOCKET, SO_NO_CHECK, 1)
        live.peer.setsockopt(socket.IPPROTO_UDP, UDP_GRO, 1)
        live.drive(lambda: live.driver.core.sent + sum(live.driver.core.errors) >= 500)
        sizes = [len(datagram) for datagram in received(live.peer, 65_536)]
        assert sizes == [DATAGRAM_BYTES] * live.driver.core.sent
        live.sockets.finish(0, live.rows)
        assert live.sockets.report()["send_errors"] == {}


@pytest.mark.sanitized
@pytest.mark.parametrize(("loops", "encrypted"), [(1, False), (1, True), (3, False), (70, True)])
def test_messages_are_handled_in_order_and_answered(
    content: dict[str, Any], loops: int, encrypted: bool
) -> None:
    phases_ns = [1000 * k for k in range(loops)]
    resolved = [scenario(content)] * loops
    given = measurements(2000 // loops, loops)
    with closing(Live("sensor", resolved, phases_ns, encrypted=encrypted)) as live:
        live.send(*given)
        live.drive_until_accepted(len(given))
        times_ns = live.rows.of(SENSOR_MEASUREMENT, NOW)
        sent, rows = one_by_one(
            live,
            [(message, now_ns + phases_ns[message.loop])
             for message, now_ns in zip(given, times_ns, strict=True)],
        )  # fmt: skip
        assert repr(live.rows.tables) == repr({SENSOR_MEASUREMENT: rows})  # with NaN
        assert received(live.peer) == sent
        assert len(sent) > 0
        live.sockets.finish(0, live.rows)
        report = live.sockets.report()
        assert (report["accepted"], report["rejected"]) == (len(given), {})
        assert (report["sent"], report["send_errors"]) == (len(sent), {})
        own = "{}:{}".format(*live.peer.getsockname())
        assert report["received_from"] == {own: len(given)}
        assert report["kernel_drops"] == 0
        each: Any = report["loops"]
        assert [loop["accepted"] for loop in each] == [len(given) // loops] * loops


@pytest.mark.sanitized
@pytest.mark.parametrize("loops", [1, 20])
@pytest.mark.parametrize("coalescing_ns", [0, 1_000_000])
@pytest.mark.parametrize("role", ["plant", "controller"])
def test_ticks_are_done_in_order_and_never_early(
    content: dict[str, Any], role: str, loops: int, coalescing_ns: int
) -> None:
    resolved = scenario(content, horizon_s=0.05)
    phases_ns = [100_000 * k for k in range(loops)]
    with closing(Live(role, [resolved] * loops, phases_ns, coalescing_ns=coalescing_ns)) as live:
        live.drive(lambda: live.driver.next_deadline_ns() is None)
        table = PLANT_STEP if role == "plant" else CONTROLLER_STEP
        due_ns, now_ns = (live.rows.of(table, column) for column in ("t_ns", NOW))
        numbers = live.rows.of(table, "loop")
        phases = [phases_ns[number] for number in numbers]
        assert all(now >= due for now, due in zip(now_ns, due_ns, strict=True))
        in_run = [(due + phase, number)
                  for due, phase, number in zip(due_ns, phases, numbers, strict=True)]  # fmt: skip
        assert in_run == sorted(in_run)
        sent, rows = one_by_one(
            live, [(None, now + phase) for now, phase in zip(now_ns, phases, strict=True)]
        )
        assert repr(live.rows.tables) == repr({table: rows})
        assert received(live.peer) == sent
        assert len(sent) > loops


@pytest.mark.sanitized
def test_acknowledgements_have_a_socket_and_counters_of_their_own(content: dict[str, Any]) -> None:
    network = content["network"] | {"protocol": "ack"}
    resolved = scenario(content, network=network)
    with closing(Live("sensor", [resolved], acknowledged=True)) as live:
        live.send(*measurements(5))
        live.drive_until_accepted(5)
        update = live.encoder.encode(Message(Flow.UPDATE, 0, 10**6, np.array([0.0, 0.0])))
        assert [data[:24] for data in received(live.peer)] == [update[:24]]  # it waits for another
        answer = Message(Flow.ACKNOWLEDGEMENT, 0, 10**6, NO_VECTOR)
        live.send(answer)  # from another address than the emulator's
        live.send(answer, by=live.answers)
        live.send(answer, by=live.answers)
        machine = live.machines.machines[0].machine
        live.drive(lambda: machine.acknowledgements.rejected[core.NOACK_STALE] == 1)
        report = live.sockets.report()
        counters = {"accepted": 1, "rejected": {"source": 1, "stale": 1}}
        assert report["acknowledgements"] == counters | {"loops": [counters]}
        assert (report["accepted"], report["rejected"]) == (5, {})
        assert sorted(live.rows.tables) == ["sensor_acknowledgement", SENSOR_MEASUREMENT]


@pytest.mark.sanitized
def test_what_cannot_be_sent_is_counted(content: dict[str, Any]) -> None:
    with closing(Live("sensor", [scenario(content)])) as live:
        live.driver.core.senders[0] = -1
        live.send(*measurements(1))
        live.drive_until_accepted(1)
        report = live.sockets.report()
        text = str(OSError(errno.EBADF, os.strerror(errno.EBADF)))
        assert (report["sent"], report["send_errors"]) == (0, {text: 1})


@pytest.mark.sanitized
def test_numbers_that_it_cannot_act_on_are_refused(content: dict[str, Any]) -> None:
    with closing(Live("sensor", [scenario(content)])) as live:
        for spin_ns, coalescing_ns in ((-1, 0), (0, -1), (0, 10**9)):
            with pytest.raises(ValueError, match="driver: spin_ns and coalescing_ns must be"):
                LiveDriver(live.machines, live.driver._wire, spin_ns=spin_ns, coalescing_ns=coalescing_ns)
