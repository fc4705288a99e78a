"""Captures and IRTT documents: valid files with changed bytes, and any bytes."""

import json
import struct

from cosim.measurement.trace_sources import SourceOptions, read_source
from noack.protocol.probe_format import ProbeDatagram, ProbeKind, encode_probe
from tests.fuzz.choices import Choices
from tests.fuzz.harness import refusal, workspace
from tests.oracles.capture_files import ETHERNET, LINKS, Sent, pcap_of, pcapng_of

_PERIOD_NS = 20_000_000
_SENT = [Sent(10**18 + k * _PERIOD_NS, struct.pack(">I", k)) for k in range(6)]
_ARRIVED = [
    one._replace(t_ns=one.t_ns + 5_000_000, interface=1, source_port=7) for one in _SENT[1:]
]
_PROBES = [
    Sent(
        10**18 + k * _PERIOD_NS,
        encode_probe(ProbeDatagram(ProbeKind.PROBE, 1, 2, k, k * _PERIOD_NS, 0, _PERIOD_NS, 6)),
    )
    for k in (0, 1, 3, 2, 5)
]
_V6 = [one._replace(source="2001:db8::1", destination="2001:db8::2") for one in _SENT]
_IRTT = json.dumps({
    "version": {"irtt": "0.9.0"},
    "round_trips": [
        {"seqno": k, "lost": k == 2, "timestamps": {"client": {
            "send": {"monotonic": k * _PERIOD_NS}, "receive": {"monotonic": k * _PERIOD_NS + 9},
        }}}
        for k in range(5)
    ],
}).encode()  # fmt: skip
_FILES = [
    pcapng_of(*_SENT, *_ARRIVED),
    pcap_of(*_SENT, link_type=ETHERNET, vlans=1),
    pcap_of(*_PROBES, order=">", nano=False),
    pcapng_of(*_V6, order=">", link_type=ETHERNET),
    *(pcap_of(*_SENT, link_type=link) for link in LINKS),
    _IRTT,
    b"0\n1\n1\n20\n",
]
_FIELDS = [None, "0:4", "2:2:little", "0:8", "9999:1", "x"]


def one_input(data: bytes) -> None:
    choices = Choices(data)
    path, other = workspace() / "one.pcap", workspace() / "other.pcap"
    options = SourceOptions(
        clocks_differ=choices.one([None, False, True]),
        flow=choices.one([1, 2, 3]),
        sequence_at=choices.one(_FIELDS),
    )
    path.write_bytes(_damaged(choices, choices.one(_FILES)))
    paths = [path]
    if choices.flag():
        other.write_bytes(pcapng_of(*_ARRIVED) if choices.flag() else path.read_bytes())
        paths.append(other)
    with refusal(
        (str(path), str(other), "expected one file", "--sequence-at", "--flow", "--clocks")
    ):
        trace = read_source(paths, options)
        received = trace.received_ns[~trace.lost]
        assert (received >= trace.sent_ns[~trace.lost]).all()


def _damaged(choices: Choices, content: bytes) -> bytes:
    changed = bytearray(content)
    for _ in range(choices.below(6)):
        at = choices.below(len(changed))
        match choices.below(4):
            case 0:
                changed[at] = choices.below(256)
            case 1:
                changed[at : at + 4] = struct.pack("<I", choices.integer() & 0xFFFF_FFFF)
            case 2:
                del changed[at : at + choices.below(64)]
            case _:
                changed[at:at] = choices.take(choices.below(16))
        if not changed:
            return b""
    return bytes(changed)
