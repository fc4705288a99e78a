"""docs/wire-vectors.json: the core makes it, and a receiver written from docs/wire.md agrees."""

import hashlib
import json
import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

from noack.protocol.wire_format import Encoder, Flow, Message
from tests.approved import compare_text
from tests.wire_decoder import Decoder

FILE = Path(__file__).parents[3] / "docs" / "wire-vectors.json"
KEY, RUN = bytes(range(32)), 0x0123_4567_89AB_CDEF
Table = dict[str, Any]
BOUNDS: Table = {"not_before_ns": 100, "not_after_ns": 10**9}


def made(
    flow: int = 2, sequence: int = 9, t_ns: int = 1000, values: tuple[float, ...] = (-0.25, 1.5),
    loop: int = 3, run: int = RUN, key: bytes = KEY, encrypted: bool = False, error_level: int = 0,
) -> bytes:  # fmt: skip
    message = Message(Flow(flow), sequence, t_ns, np.array(values), loop, error_level)
    return Encoder(run, key, encrypted=encrypted).encode(message)


def flipped(datagram: bytes, at: int) -> bytes:
    return datagram[:at] + bytes([datagram[at] ^ 1]) + datagram[at + 1 :]


def datagrams(*, encrypted: bool) -> Iterator[tuple[str, bytes, bool]]:
    """What arrives at a receiver of updates, in this order: what it is, it, from the peer."""

    def own(**values: Any) -> bytes:
        return made(encrypted=encrypted, **values)

    yield "the first", own(sequence=7, t_ns=100), True
    yield "the next after a gap", own(), True
    yield "the same again", own(), True
    yield "an older one", own(sequence=8), True
    yield "nothing", b"", True
    yield "truncated before the end of the header", own(sequence=10)[:31], True
    yield "truncated by a byte", own(sequence=10)[:-1], True
    yield "one byte more", own(sequence=10) + b"\0", True
    yield "of one entry", own(sequence=10, values=(1.0,)), True
    yield "another magic", b"M" + own(sequence=10)[1:], True
    yield "the other version", made(sequence=10, encrypted=not encrypted), True
    yield "of another run", own(sequence=10, run=RUN + 1), True
    yield "the other direction: an actuation", own(sequence=10, flow=3), True
    yield "of another loop", own(sequence=10, loop=4), True
    yield "under another key", own(sequence=10, key=bytes(32)), True
    for at in (5, 16, 24, 32, 63):
        yield f"a bit flipped in byte {at}", flipped(own(sequence=10), at), True
    yield "from another address", own(sequence=10), False
    yield "before time 0", own(sequence=10, t_ns=-1), True
    yield "before not_before_ns", own(sequence=10, t_ns=99), True
    yield "at not_after_ns", own(sequence=10, t_ns=10**9), True
    yield "with an error level", own(sequence=11, t_ns=10**9, error_level=142), True
    yield "after not_after_ns", own(sequence=11, t_ns=10**9 + 1), True
    yield "an infinity", own(sequence=12, values=(1.0, math.inf)), True
    yield "not a number", own(sequence=12, values=(math.nan, 1.0)), True
    yield "the same number, finite", own(sequence=12, values=(-0.0, 5e-324)), True
    yield "a number of 2^63", own(sequence=2**63), True
    yield "the largest number", own(sequence=2**63 - 1), True
    yield "a smaller one", own(sequence=13), True


def by_the_core(*, encrypted: bool) -> Iterator[Table]:
    decoder = Decoder(Flow.UPDATE, 2, RUN, KEY, not_before_ns=100, loop=3, encrypted=encrypted)
    decoder._reception.not_after_ns = BOUNDS["not_after_ns"]
    for what, data, from_peer in datagrams(encrypted=encrypted):
        before = dict(decoder.rejected)
        message = decoder.decode(data, from_peer=from_peer)
        entry: Table = {"what": what, "from_peer": from_peer, "datagram": data.hex()}
        if message is None:
            (reason,) = (key for key, n in decoder.rejected.items() if n != before[key])
            yield entry | {"result": reason.value}
        else:
            own = {"sequence": str(message.sequence), "t_ns": str(message.t_ns)}
            own |= {"error_level": message.error_level} if message.error_level else {}
            yield entry | {"result": "accepted", **own, "vector": message.vector.tolist()}


def text() -> str:
    """The file, by the core; numbers that may exceed 2^53 are texts."""
    receivers: list[Table] = [
        {
            "receives": {"version": version, "flow": 2, "dimension": 2, "run_id": f"{RUN:016x}",
                         "loop": 3, **BOUNDS},
            "datagrams": [*by_the_core(encrypted=version == 2)],
        }
        for version in (1, 2)
    ]  # fmt: skip
    about = "Datagrams in the order in which a receiver gets them; see wire.md, Test vectors"
    return json.dumps({"about": about, "key": KEY.hex(), "receivers": receivers}, indent=1) + "\n"


def test_the_file_is_what_the_core_does() -> None:
    compare_text(FILE, text())


class PageReceiver:
    """A receiver written from docs/wire.md alone."""

    def __init__(self, key: bytes, receives: Table) -> None:
        self._key, self._own, self._newest = key, receives, -1

    def examine(self, data: bytes, *, from_peer: bool) -> tuple[str, Table]:
        own = self._own
        if len(data) < 32:
            return "length", {}
        magic, version, flow, n, level, loop, run_id, sequence, t_ns = struct.unpack_from("<2sBBBBHQQq", data)
        tests = [
            ("version", magic == b"NA" and version == own["version"]),
            ("length", n == own["dimension"] and len(data) == 48 + 8 * n),
            ("run", run_id == int(own["run_id"], 16)), ("flow", flow == own["flow"]),
            ("loop", loop == own["loop"]),
        ]  # fmt: skip
        for reason, holds in tests:
            if not holds:
                return reason, {}
        if (content := self._opened(data, struct.pack("<BBHQ", flow, 0, loop, sequence))) is None:
            return "tag", {}
        vector = [*struct.unpack(f"<{n}d", content)]
        tests = [
            ("source", from_peer),
            ("range", sequence < 2**63 and 0 <= t_ns <= own["not_after_ns"]),
            ("stale", sequence > self._newest and t_ns >= own["not_before_ns"]),
            ("not_finite", all(map(math.isfinite, vector))),
        ]
        for reason, holds in tests:
            if not holds:
                return reason, {}
        self._newest = sequence
        own = {"sequence": str(sequence), "t_ns": str(t_ns), "vector": vector}
        return "accepted", own | ({"error_level": level} if level else {})

    def _opened(self, data: bytes, nonce: bytes) -> bytes | None:
        if self._own["version"] == 1:
            tag = hashlib.blake2b(data[:-16], key=self._key, digest_size=16).digest()
            return data[32:-16] if tag == data[-16:] else None
        own = hashlib.blake2b(b"noack datagrams", key=self._key, digest_size=32).digest()
        try:
            return ChaCha20Poly1305(own).decrypt(nonce, data[32:], data[:32])
        except InvalidTag:
            return None


def test_a_receiver_written_from_the_page_agrees_with_the_file() -> None:
    found = json.loads(FILE.read_text())
    results: set[str] = set()
    for one in found["receivers"]:
        receiver = PageReceiver(bytes.fromhex(found["key"]), one["receives"])
        for entry in one["datagrams"]:
            data = bytes.fromhex(entry["datagram"])
            result, fields = receiver.examine(data, from_peer=entry["from_peer"])
            assert result == entry["result"], entry["what"]
            assert repr(fields) == repr({key: entry[key] for key in fields}), entry["what"]
            results.add(result)
    assert len(results) == 11  # each reason but `shed`, and accepted
