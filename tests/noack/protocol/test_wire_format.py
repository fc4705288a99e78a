"""The wire format against docs/wire.md, its vectors, and docs/wire-vectors.json, which the core makes.

``tests/oracles/wire.py`` builds datagrams and receives them by the page, independently of the code.
"""

import itertools
import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from noack.protocol.wire_format import (
    MAX_LOOPS,
    Encoder,
    Flow,
    Header,
    Message,
    Rejection,
    loop_number,
    read_header,
)
from tests.helpers.approved import compare_text
from tests.oracles.wire import ACCEPTED, KEY, RUN, BothReceivers, datagram

pytestmark = pytest.mark.sanitized

DOCS = Path(__file__).parents[3] / "docs"
PAGE = (DOCS / "wire.md").read_text(encoding="utf-8")
FLOWS = {"measurement": 1, "update": 2, "actuation": 3, "acknowledgement": 4}

run_ids = st.integers(0, 2**64 - 1)
sequences = st.integers(0, 2**63 - 1)
times_ns = st.integers(0, 2**62 - 1)
finite = st.floats(allow_nan=False, allow_infinity=False)
vectors = st.lists(finite, min_size=1, max_size=64)
flows = st.sampled_from(Flow)
loops = st.integers(0, 65_533)


class Vector(NamedTuple):
    """A published datagram."""

    version: int
    flow: str
    loop: int
    run_id: int
    sequence: int
    t_ns: int
    values: list[float]
    data: bytes
    error_level: int


def published_vector(block: str) -> Vector:
    fields = dict(re.findall(r"^([a-z_ ]+): +(.*?)(?=^[a-z]|\Z)", block, re.DOTALL | re.MULTILINE))
    run_id, sequence, t_ns = int(fields["run id"], 16), int(fields["sequence"]), int(fields["t_ns"])
    values = [float(value) for value in fields["vector"].split() if value != "none"]
    data = bytes.fromhex(fields["datagram"])
    loop, version = int(fields.get("loop", "0")), int(fields.get("version", "1"))
    level = int(fields.get("error level", "0"))
    return Vector(version, fields["flow"].strip(), loop, run_id, sequence, t_ns, values, data, level)


VECTORS = [published_vector(block) for block in re.findall(r"```vector\n(.*?)```", PAGE, re.DOTALL)]


def test_the_page_has_a_vector_for_every_flow_and_names_its_key() -> None:
    assert {vector.flow for vector in VECTORS} == set(FLOWS)
    assert {flow.name.lower(): flow.value for flow in Flow} == FLOWS
    assert f"The key of all vectors is `{KEY.hex()}`" in PAGE


@pytest.mark.parametrize("vector", VECTORS, ids=lambda v: f"v{v.version}-{v.flow}-{v.loop}-{v.sequence}")
def test_published_vectors_hold_in_both_directions(vector: Vector) -> None:
    version, name, loop, run_id, sequence, t_ns, values, data, level = vector
    flow = Flow(FLOWS[name])
    assert_encoded_and_decoded(flow, level, loop, run_id, sequence, t_ns, values, version == 2)
    by_hand = datagram(
        values, version=version, flow=flow, loop=loop, run_id=run_id, sequence=sequence, t_ns=t_ns,
        error_level=level,
    )  # fmt: skip
    assert by_hand.hex() == data.hex()
    assert read_header(data[:31]) is read_header(b"x" + data) is None


def test_the_page_gives_the_reasons_in_the_order_of_the_tests() -> None:
    listed = re.findall(r"^\| (\d+) \| `(\w+)` \|", PAGE, re.MULTILINE)
    assert [int(order) for order, _ in listed] == list(range(1, 12))
    assert [reason for _, reason in listed] == ["length", *(reason for reason, _ in FAULTS)]
    assert {reason for _, reason in listed} == {reason.value for reason in Rejection}


def assert_encoded_and_decoded(
    flow: Flow, level: int, loop: int, run_id: int, sequence: int, t_ns: int, values: list[float],
    encrypted: bool,
) -> None:  # fmt: skip
    """The core makes the page's datagram, and both receivers accept it; another loop's do not."""
    message = Message(flow, sequence, t_ns, np.array(values), loop, level)
    data = Encoder(run_id, KEY, encrypted=encrypted).encode(message)
    version = 1 + encrypted
    assert data == datagram(
        values, version=version, flow=flow, loop=loop, run_id=run_id, sequence=sequence, t_ns=t_ns,
        error_level=level,
    )  # fmt: skip
    assert loop_number(data) == loop
    assert read_header(data) == Header(version, flow, len(values), level, loop, run_id, sequence, t_ns)
    own, other = (
        BothReceivers(flow, len(values), run_id=run_id, loop=number, encrypted=encrypted)
        for number in (loop, loop + 1)
    )
    assert own.examine(data)[0] == ACCEPTED
    assert own.message is not None
    assert (own.message.flow, own.message.loop) == (flow, loop)
    assert other.examine(data)[0] == "loop"
    renamed = data[:6] + (loop + 1).to_bytes(2, "little") + data[8:]
    assert other.examine(renamed)[0] == "tag"  # it covers the number of the loop


@given(flows, st.integers(0, 255), loops, run_ids, sequences, times_ns, vectors, st.booleans())
@example(
    Flow.UPDATE, 0, 0, 0, 0, 0, [-0.0, 5e-324, -2.2250738585072014e-308, 1.7976931348623157e308], False
)  # fmt: skip
def test_encoded_messages_decode_unchanged(
    flow: Flow, level: int, loop: int, run_id: int, sequence: int, t_ns: int, values: list[float],
    encrypted: bool,
) -> None:  # fmt: skip
    values = [] if flow is Flow.ACKNOWLEDGEMENT else values
    assert_encoded_and_decoded(flow, level, loop, run_id, sequence, t_ns, values, encrypted)


@given(vectors, sequences, times_ns, st.booleans())
def test_any_flipped_bit_is_rejected(values: list[float], sequence: int, t_ns: int, encrypted: bool) -> None:
    receivers = BothReceivers(dimension=len(values), encrypted=encrypted)
    data = datagram(values, version=1 + encrypted, sequence=sequence, t_ns=t_ns)
    stride = 1 if len(values) <= 3 else 13  # some bits of the longer ones
    for bit in range(0, 8 * len(data), stride):
        damaged = bytearray(data)
        damaged[bit // 8] ^= 1 << bit % 8
        assert receivers.examine(bytes(damaged))[0] != ACCEPTED
    assert receivers.examine(data)[0] == ACCEPTED


FAULTS: list[tuple[str, dict[str, Any]]] = [
    ("version", {"version": 2}),
    ("length", {"dimension": 2}),
    ("run", {"run_id": RUN + 1}),
    ("flow", {"flow": 3}),
    ("loop", {"loop": 1}),
    ("tag", {"key": bytes(range(1, 33))}),
    ("source", {"from_peer": False}),
    ("range", {"t_ns": -1}),
    ("stale", {"sequence": 8}),
    ("not_finite", {"values": [0.0, math.nan, 0.0]}),
]


def test_only_the_first_of_several_faults_is_counted() -> None:
    receivers = BothReceivers()
    receivers.examine(datagram([0.0, 0.0, 0.0], sequence=8))
    for present in itertools.product((False, True), repeat=len(FAULTS)):
        given_values: dict[str, Any] = {"values": [0.0, 0.0, 0.0], "sequence": 9}
        faults = list(itertools.compress(FAULTS, present))
        for _, fault in faults:
            given_values |= fault
        from_peer = given_values.pop("from_peer", True)
        if faults:
            result, _ = receivers.examine(datagram(**given_values), from_peer=from_peer)
            assert result == faults[0][0]


def test_a_vector_or_key_that_a_flow_cannot_have_is_refused() -> None:
    with pytest.raises(ValueError, match=r"carries no vector of shape \(1,\)"):
        Encoder(RUN, KEY).encode(Message(Flow.ACKNOWLEDGEMENT, 0, 0, np.zeros(1)))
    with pytest.raises(ValueError, match="does not fit its field"):
        Encoder(RUN, KEY).encode(Message(Flow.UPDATE, 0, 0, np.zeros(1), error_level=256))
    for loop in (-1, MAX_LOOPS):
        with pytest.raises(ValueError, match=f"does not fit its field: loop {loop}"):
            Encoder(RUN, KEY).encode(Message(Flow.UPDATE, 0, 0, np.zeros(1), loop=loop))
    for loop in (0, MAX_LOOPS - 1):
        datagram = Encoder(RUN, KEY).encode(Message(Flow.UPDATE, 0, 0, np.zeros(1), loop=loop))
        assert loop_number(datagram) == loop
    with pytest.raises(ValueError, match="32 bytes, not 31"):
        Encoder(RUN, bytes(31))
    for shape in ((0,), (65,), (2, 2), (1, 3)):
        with pytest.raises(ValueError, match=r"1 to 64 entries, not shape"):
            Encoder(RUN, KEY).encode(Message(Flow.UPDATE, 0, 0, np.zeros(shape)))


# --- docs/wire-vectors.json -----------------------------------------------------------------------

Table = dict[str, Any]
BOUNDS: Table = {"not_after_ns": 10**9}


def flipped(data: bytes, at: int) -> bytes:
    return data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]


def datagrams(*, encrypted: bool) -> Iterator[tuple[str, bytes, bool]]:
    """What arrives at a receiver of updates, in this order: what it is, it, from the peer."""

    def made(
        flow: int = 2, sequence: int = 9, t_ns: int = 1000, values: tuple[float, ...] = (-0.25, 1.5),
        loop: int = 3, run: int = RUN, key: bytes = KEY, encrypted: bool = encrypted, error_level: int = 0,
    ) -> bytes:  # fmt: skip
        message = Message(Flow(flow), sequence, t_ns, np.array(values), loop, error_level)
        return Encoder(run, key, encrypted=encrypted).encode(message)

    yield "the first", made(sequence=7, t_ns=100), True
    yield "the next after a gap", made(), True
    yield "the same again", made(), True
    yield "an older one", made(sequence=8), True
    yield "nothing", b"", True
    yield "truncated before the end of the header", made(sequence=10)[:31], True
    yield "truncated by a byte", made(sequence=10)[:-1], True
    yield "one byte more", made(sequence=10) + b"\0", True
    yield "of one entry", made(sequence=10, values=(1.0,)), True
    yield "another magic", b"M" + made(sequence=10)[1:], True
    yield "the other version", made(sequence=10, encrypted=not encrypted), True
    yield "of another run", made(sequence=10, run=RUN + 1), True
    yield "the other direction: an actuation", made(sequence=10, flow=3), True
    yield "of another loop", made(sequence=10, loop=4), True
    yield "under another key", made(sequence=10, key=bytes(32)), True
    for at in (5, 16, 24, 32, 63):
        yield f"a bit flipped in byte {at}", flipped(made(sequence=10), at), True
    yield "from another address", made(sequence=10), False
    yield "before time 0", made(sequence=10, t_ns=-1), True
    yield "at not_after_ns", made(sequence=10, t_ns=10**9), True
    yield "with an error level", made(sequence=11, t_ns=10**9, error_level=142), True
    yield "after not_after_ns", made(sequence=11, t_ns=10**9 + 1), True
    yield "an infinity", made(sequence=12, values=(1.0, math.inf)), True
    yield "not a number", made(sequence=12, values=(math.nan, 1.0)), True
    yield "the same number, finite", made(sequence=12, values=(-0.0, 5e-324)), True
    yield "a number of 2^63", made(sequence=2**63), True
    yield "the largest number", made(sequence=2**63 - 1), True
    yield "a smaller one", made(sequence=13), True


def results(*, encrypted: bool) -> Iterator[Table]:
    """What both receivers say of each datagram; numbers that may exceed 2^53 are texts."""
    receivers = BothReceivers(dimension=2, loop=3, encrypted=encrypted, **BOUNDS)
    for what, data, from_peer in datagrams(encrypted=encrypted):
        result, fields = receivers.examine(data, from_peer=from_peer)
        for name in fields.keys() & {"sequence", "t_ns"}:
            fields[name] = str(fields[name])
        if not fields.get("error_level"):
            fields.pop("error_level", None)
        yield {"what": what, "from_peer": from_peer, "datagram": data.hex(), "result": result, **fields}


def test_the_published_file_is_what_both_receivers_do() -> None:
    receivers: list[Table] = [
        {
            "receives": {"version": version, "flow": 2, "dimension": 2, "run_id": f"{RUN:016x}",
                         "loop": 3, **BOUNDS},
            "datagrams": [*results(encrypted=version == 2)],
        }
        for version in (1, 2)
    ]  # fmt: skip
    seen = {entry["result"] for receiver in receivers for entry in receiver["datagrams"]}
    assert len(seen) == 11  # each reason but `shed`, and accepted
    about = "Datagrams in the order in which a receiver gets them; see wire.md, Test vectors"
    text = json.dumps({"about": about, "key": KEY.hex(), "receivers": receivers}, indent=1) + "\n"
    compare_text(DOCS / "wire-vectors.json", text)
