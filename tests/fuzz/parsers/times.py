"""Datagrams of the exchange of timestamps: random, authentic but malformed, and modified."""

import hashlib
import struct

from noack.protocol.wire_format import Rejection
from noack.runtime.host_clocks.time_exchange import TIME_BYTES, TimeDatagram, TimeFormat, TimeKind
from tests.fuzz.choices import Choices

KEY = bytes(range(32))
WORDS = (b"NC\x01\x01\0\0\0\0", b"NC\x01\x02\0\0\0\0")
_CONTENT = "<2sBBI16sQqq"


def one_input(data: bytes) -> None:
    form, choices = TimeFormat(KEY), Choices(data)
    for kind in TimeKind:
        assert isinstance(form.decode(data, kind), Rejection)
    while choices.left:
        magic, version = choices.one([b"NC", b"NA", b"\0\0"]), choices.one([1, 0, 255])
        number, reserved = choices.one([1, 2, 0, 255]), choices.one([0, 0, 1])
        times = [(choices.integer() + 2**63) % 2**64 - 2**63 for _ in range(2)]
        nonce, clock = choices.take(16), choices.integer() % 2**64
        content = struct.pack(_CONTENT, magic, version, number, reserved, nonce, clock, *times)
        datagram = whole = content + hashlib.blake2b(content, key=KEY, digest_size=16).digest()
        match choices.below(4):
            case 1:
                bits = int.from_bytes(datagram, "little") ^ (1 << choices.below(8 * TIME_BYTES))
                datagram = bits.to_bytes(TIME_BYTES, "little")
            case 2:
                datagram = datagram[: choices.below(TIME_BYTES)]
            case 3:
                datagram += choices.take(1 + choices.below(16))
        is_sound = datagram == whole and (magic, version, reserved) == (b"NC", 1, 0)
        for kind in TimeKind:
            found = form.decode(datagram, kind)
            expected = is_sound and number == kind and 0 <= times[0] <= times[1] < 2**62
            assert isinstance(found, TimeDatagram) == expected
            if isinstance(found, TimeDatagram):
                assert form.encode(found) == datagram
