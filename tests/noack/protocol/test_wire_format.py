""":func:`datagram` builds every datagram here from ``docs/wire.md``, independently of the code."""

import hashlib
import itertools
import math
import re
import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305
from hypothesis import example, given
from hypothesis import strategies as st

from noack.protocol.wire_format import Encoder, Flow, Header, Message, Rejection, loop_number, read_header
from tests.wire_decoder import Decoder

PAGE = (Path(__file__).parents[3] / "docs" / "wire.md").read_text(encoding="utf-8")
FLOWS = {"measurement": 1, "update": 2, "actuation": 3, "acknowledgement": 4}
KEY, OTHER_KEY = bytes(range(32)), bytes(range(1, 33))
RUN = 0x0123_4567_89AB_CDEF

run_ids = st.integers(0, 2**64 - 1)
sequences = st.integers(0, 2**63 - 1)
times_ns = st.integers(0, 2**62 - 1)
finite = st.floats(allow_nan=False, allow_infinity=False)
vectors = st.lists(finite, min_size=1, max_size=64)
flows = st.sampled_from(Flow)
loops = st.integers(0, 65_533)


def datagram(
    values: list[float],
    *,
    magic: bytes = b"NA",
    version: int = 1,
    flow: int = 2,
    dimension: int | None = None,
    error_level: int = 0,
    loop: int = 0,
    run_id: int = RUN,
    sequence: int = 0,
    t_ns: int = 0,
    key: bytes = KEY,
) -> bytes:
    """A datagram by the tables of ``docs/wire.md``, with a valid tag under ``key``."""
    header = b"".join(
        [
            magic,
            version.to_bytes(1, "little"),
            flow.to_bytes(1, "little"),
            (len(values) if dimension is None else dimension).to_bytes(1, "little"),
            error_level.to_bytes(1, "little"),
            loop.to_bytes(2, "little"),
            run_id.to_bytes(8, "little"),
            sequence.to_bytes(8, "little"),
            t_ns.to_bytes(8, "little", signed=True),
        ]
    )
    vector = b"".join(struct.pack("<d", value) for value in values)
    if version == 2:
        nonce = struct.pack("<BBHQ", flow, 0, loop, sequence)
        own_key = hashlib.blake2b(b"noack datagrams", key=key, digest_size=32).digest()
        return header + ChaCha20Poly1305(own_key).encrypt(nonce, vector, header)
    content = header + vector
    return content + hashlib.blake2b(content, key=key, digest_size=16).digest()


def new_decoder(flow: int = 2, dimension: int = 3, run_id: int = RUN, *, encrypted: bool = False) -> Decoder:
    return Decoder(Flow(flow), dimension, run_id, KEY, encrypted=encrypted)


def assert_rejected(decoder: Decoder, data: bytes, reason: Rejection, *, from_peer: bool = True) -> None:
    """The datagram is rejected for that reason and counted once; nothing else changes."""
    accepted, rejected = decoder.accepted, dict(decoder.rejected)
    assert decoder.decode(data, from_peer=from_peer) is None
    counted = {key: n - rejected[key] for key, n in decoder.rejected.items() if n != rejected[key]}
    assert counted == {reason: 1}
    assert decoder.accepted == accepted


class Vector(NamedTuple):
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
    loop = int(fields.get("loop", "0"))
    version = int(fields.get("version", "1"))
    level = int(fields.get("error level", "0"))
    return Vector(version, fields["flow"].strip(), loop, run_id, sequence, t_ns, values, data, level)


VECTORS = [published_vector(block) for block in re.findall(r"```vector\n(.*?)```", PAGE, re.DOTALL)]


def test_the_page_has_a_vector_for_every_flow_and_names_its_key() -> None:
    assert {vector.flow for vector in VECTORS} == set(FLOWS)
    assert {flow.name.lower(): flow.value for flow in Flow} == FLOWS
    assert f"The key of all vectors is `{KEY.hex()}`" in PAGE


@pytest.mark.parametrize("vector", VECTORS, ids=lambda v: f"v{v.version}-{v.flow}-{v.loop}-{v.sequence}")
def test_published_vectors_hold_in_both_directions(vector: Vector) -> None:
    version, flow, loop, run_id, sequence, t_ns, values, data, level = vector
    by_hand = datagram(
        values, version=version, flow=FLOWS[flow], loop=loop, run_id=run_id, sequence=sequence,
        t_ns=t_ns, error_level=level,
    )  # fmt: skip
    encrypted = version == 2
    assert by_hand.hex() == data.hex()
    message = Message(Flow(FLOWS[flow]), sequence, t_ns, np.array(values), loop, level)
    assert Encoder(run_id, KEY, encrypted=encrypted).encode(message).hex() == data.hex()
    decoder = Decoder(
        Flow(FLOWS[flow]), len(values), run_id, KEY, loop=loop, encrypted=encrypted
    )  # fmt: skip
    decoded = decoder.decode(data)
    assert decoded is not None
    assert decoded[:3] == message[:3]
    assert decoded.vector.tobytes() == struct.pack(f"<{len(values)}d", *values)
    assert decoded.error_level == level
    header = Header(version, FLOWS[flow], len(values), level, loop, run_id, sequence, t_ns)
    assert read_header(data) == header
    assert read_header(data[:31]) is read_header(b"x" + data) is None


def test_the_page_gives_the_reasons_in_the_order_of_the_tests() -> None:
    listed = re.findall(r"^\| (\d+) \| `(\w+)` \|", PAGE, re.MULTILINE)
    assert [int(order) for order, _ in listed] == list(range(1, 12))
    assert [reason for _, reason in listed] == ["length", *(reason for reason, _ in FAULTS)]
    assert {reason for _, reason in listed} == {reason.value for reason in Rejection}


@given(flows, st.integers(0, 255), loops, run_ids, sequences, times_ns, vectors, st.booleans())
@example(
    Flow.UPDATE, 0, 0, 0, 0, 0, [-0.0, 5e-324, -2.2250738585072014e-308, 1.7976931348623157e308], False
)  # fmt: skip
def test_encoded_messages_decode_unchanged(
    flow: Flow, level: int, loop: int, run_id: int, sequence: int, t_ns: int, values: list[float],
    encrypted: bool,
) -> None:  # fmt: skip
    """Those of another loop are rejected; the tag covers the number of the loop."""
    values = [] if flow is Flow.ACKNOWLEDGEMENT else values
    encoder = Encoder(run_id, KEY, encrypted=encrypted)
    data = encoder.encode(Message(flow, sequence, t_ns, np.array(values), loop, level))
    version = 1 + encrypted
    assert data == datagram(
        values,
        version=version,
        flow=flow,
        loop=loop,
        run_id=run_id,
        sequence=sequence,
        t_ns=t_ns,
        error_level=level,
    )
    assert loop_number(data) == loop
    assert read_header(data) == Header(version, flow, len(values), level, loop, run_id, sequence, t_ns)
    decoder = Decoder(flow, len(values), run_id, KEY, loop=loop, encrypted=encrypted)
    message = decoder.decode(data)
    assert message is not None
    assert (message[:3], message[4:]) == ((flow, sequence, t_ns), (loop, level))
    assert message.vector.dtype == np.float64
    assert message.vector.tobytes() == struct.pack(f"={len(values)}d", *values)
    assert decoder.accepted == 1
    assert set(decoder.rejected.values()) == {0}
    other = Decoder(flow, len(values), run_id, KEY, loop=loop + 1, encrypted=encrypted)
    assert_rejected(other, data, Rejection.LOOP)
    renamed = data[:6] + (loop + 1).to_bytes(2, "little") + data[8:]
    assert_rejected(other, renamed, Rejection.TAG)


def reason_by_offset(offset: int) -> Rejection:
    """The first test that a changed byte fails, by the table of the layout."""
    if offset < 3:
        return Rejection.VERSION  # magic and version
    if offset == 3:
        return Rejection.FLOW
    if offset == 4:
        return Rejection.LENGTH  # dimension
    if offset in (6, 7):
        return Rejection.LOOP
    if 8 <= offset < 16:
        return Rejection.RUN
    return Rejection.TAG  # error level, sequence number, time, vector, and the tag itself


@given(vectors, sequences, times_ns, st.booleans())
def test_any_flipped_bit_is_rejected(values: list[float], sequence: int, t_ns: int, encrypted: bool) -> None:
    decoder = new_decoder(dimension=len(values), encrypted=encrypted)
    data = datagram(values, version=1 + encrypted, sequence=sequence, t_ns=t_ns)
    stride = 1 if len(values) <= 3 else 13  # some bits of the longer ones
    for bit in range(0, 8 * len(data), stride):
        damaged = bytearray(data)
        damaged[bit // 8] ^= 1 << bit % 8
        assert_rejected(decoder, bytes(damaged), reason_by_offset(bit // 8))
    assert decoder.decode(data) is not None


@given(vectors, st.booleans())
def test_a_run_accepts_one_version_only(values: list[float], encrypted: bool) -> None:
    """Nobody makes an encrypted run accept what is readable, nor the reverse."""
    decoder = new_decoder(dimension=len(values), encrypted=encrypted)
    other = datagram(values, version=2 - encrypted)
    assert_rejected(decoder, other, Rejection.VERSION)
    renamed = other[:2] + bytes([1 + encrypted]) + other[3:]
    assert_rejected(decoder, renamed, Rejection.TAG)


FAULTS = [
    ("version", {"version": 2}),
    ("length", {"dimension": 2}),
    ("run", {"run_id": RUN + 1}),
    ("flow", {"flow": 3}),
    ("loop", {"loop": 1}),
    ("tag", {"key": OTHER_KEY}),
    ("source", {"from_peer": False}),
    ("range", {"t_ns": -1}),
    ("stale", {"sequence": 8}),
    ("not_finite", {"values": [0.0, math.nan, 0.0]}),
]


@pytest.mark.parametrize("first", range(len(FAULTS)))
def test_only_the_first_of_several_faults_is_counted(first: int) -> None:
    decoder = new_decoder()
    assert decoder.decode(datagram([0.0, 0.0, 0.0], sequence=8)) is not None
    reason, fault = FAULTS[first]
    for others in itertools.product((False, True), repeat=len(FAULTS) - first - 1):
        faults = {"values": [0.0, 0.0, 0.0], "sequence": 9} | fault
        for (_, other), present in zip(FAULTS[first + 1 :], others, strict=True):
            faults |= other if present else {}
        from_peer = faults.pop("from_peer", True)
        assert_rejected(decoder, datagram(**faults), Rejection(reason), from_peer=from_peer)
    assert decoder.decode(datagram([0.0, 0.0, 0.0], sequence=9)) is not None


def test_an_acknowledgement_carries_no_vector() -> None:
    with pytest.raises(ValueError, match=r"carries no vector of shape \(1,\)"):
        Encoder(RUN, KEY).encode(Message(Flow.ACKNOWLEDGEMENT, 0, 0, np.zeros(1)))
    decoder = new_decoder(flow=4, dimension=0)
    assert_rejected(decoder, datagram([0.0], flow=4), Rejection.LENGTH)
    assert_rejected(decoder, datagram([], flow=2), Rejection.FLOW)
    message = decoder.decode(datagram([], flow=4, sequence=7, t_ns=5))
    assert message is not None
    assert (*message[:3], message.vector.size) == (Flow.ACKNOWLEDGEMENT, 7, 5, 0)


def test_a_key_or_a_vector_of_another_size_is_refused() -> None:
    with pytest.raises(ValueError, match="does not fit its field"):
        Encoder(RUN, KEY).encode(Message(Flow.UPDATE, 0, 0, np.zeros(1), error_level=256))
    with pytest.raises(ValueError, match="32 bytes, not 31"):
        Encoder(RUN, bytes(31))
    for shape in ((0,), (65,), (2, 2), (1, 3)):
        with pytest.raises(ValueError, match=r"1 to 64 entries, not shape"):
            Encoder(RUN, KEY).encode(Message(Flow.UPDATE, 0, 0, np.zeros(shape)))
