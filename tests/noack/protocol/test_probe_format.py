"""The datagrams of probes against the table of their layout, and what is refused."""

import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from noack.protocol.probe_format import PROBE_BYTES, ProbeDatagram, ProbeKind, decode_probe, encode_probe

numbers = st.integers(0, 2**62)
probes = st.builds(
    ProbeDatagram, st.sampled_from(ProbeKind), st.integers(0, 2**64 - 1), st.integers(0, 2**64 - 1),
    st.integers(0, 10**6), st.just(2**62), st.integers(-(2**60), 2**60), st.integers(50_000, 10**9),
    st.integers(0, 10**6), numbers, numbers, st.integers(0, 2**128 - 1),
)  # fmt: skip


@given(probes, st.integers(PROBE_BYTES, 1500))
def test_each_field_is_where_the_table_says(probe: ProbeDatagram, size_bytes: int) -> None:
    data = encode_probe(probe, size_bytes)
    assert len(data) == size_bytes
    assert data[:8] == b"NAMP\1" + bytes([probe.kind, 0, 0])
    assert int.from_bytes(data[8:12], "little") == zlib.crc32(data[:8] + data[12:])
    fields = [(at, at + 8) for at in range(12, 84, 8)] + [(84, 100)]
    signed = (36, 44)
    numbers = [int.from_bytes(data[at:end], "little", signed=at in signed) for at, end in fields]
    assert numbers == [*probe[1:]]
    assert not any(data[100:])
    assert decode_probe(data) == probe


PROBE = ProbeDatagram(ProbeKind.PROBE, 7, 5, 3, 4_000_000, 0, 1_000_000, 100)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (encode_probe(PROBE)[:-1], "foreign"),
        (b"X" + encode_probe(PROBE)[1:], "foreign"),
        (b"NAMP\2" + encode_probe(PROBE)[5:], "version"),
        (encode_probe(PROBE)[:-1] + b"\1", "corrupted"),
        (encode_probe(PROBE._replace(period_ns=49_999)), "impossible"),
        (encode_probe(PROBE._replace(sent_ns=2_999_999)), "impossible"),
    ],
)
def test_other_datagrams_are_refused_with_a_word(data: bytes, reason: str) -> None:
    with pytest.raises(ValueError, match=f"^{reason}$"):
        decode_probe(data)
