"""``docs/noack.lua`` in tshark, over datagrams of :mod:`noack.protocol.wire_format`."""

import re
import shlex
import shutil
import subprocess
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from noack.protocol.wire_format import HEADER_BYTES, TAG_BYTES, Encoder, Flow, Message
from tests.oracles.capture_files import Sent, pcap_of

Tshark = Callable[..., str]


@pytest.fixture
def tshark(tmp_path: Path) -> Tshark:
    """Run tshark on a file and return its output; it must report no error."""
    program = shutil.which("tshark")
    if program is None:
        pytest.skip("tshark is not installed")

    def run(capture: Path, *arguments: str) -> str:
        done = subprocess.run(
            [program, "-n", "-r", str(capture), *arguments],
            env={"HOME": str(tmp_path), "LC_ALL": "C.UTF-8", "PATH": "/usr/bin:/bin"},
            capture_output=True, text=True, check=False, timeout=60,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        complaints = [line for line in done.stderr.splitlines() if "dangerous" not in line]
        assert complaints == []
        return done.stdout

    return run


DOCS = Path(__file__).parents[2] / "docs"
PORT = 40_002
T_NS = 1_767_225_600_123_456_789
RUN = 0x0123_4567_89AB_CDEF
Fields = dict[str, list[dict[str, str]]]


def capture_of(folder: Path, *payloads: bytes) -> Path:
    path = folder / "capture.pcap"
    path.write_bytes(pcap_of(*(Sent(T_NS, payload, destination_port=PORT) for payload in payloads)))
    return path


def dissected(tshark: Tshark, folder: Path, *payloads: bytes) -> list[Fields]:
    """Return tshark's fields of each payload: ``show`` as text, ``value`` as hex."""
    packets = []
    path = capture_of(folder, *payloads)
    text = tshark(path, "-X", f"lua_script:{DOCS / 'noack.lua'}", "-T", "pdml")
    for packet in ET.fromstring(text).iter("packet"):
        fields: Fields = {}
        for field in packet.iter("field"):
            fields.setdefault(field.attrib["name"], []).append(field.attrib)
        packets.append(fields)
    return packets


def shown(fields: Fields, name: str) -> str:
    (field,) = fields[f"noack.{name}"]
    return field["show"]


@pytest.mark.parametrize("encrypted", [False, True])
def test_the_dissector_shows_every_field(tshark: Tshark, tmp_path: Path, encrypted: bool) -> None:
    messages = [
        Message(Flow.UPDATE, 2**64 - 1, -1, np.array([-0.0, 5e-324, -1.5e308]), error_level=255),
        Message(Flow.ACTUATION, 0, -(2**63), np.array([1.0])),
        Message(Flow.MEASUREMENT, 1, 2**63 - 1, np.full(64, 0.1), 2**16 - 2),
        Message(Flow.ACKNOWLEDGEMENT, 17, 1_234_000_000, np.zeros(0)),
    ]
    encoder = Encoder(RUN, bytes(32), encrypted=encrypted)
    datagrams = [encoder.encode(message) for message in messages]
    packets = dissected(tshark, tmp_path, *datagrams)
    for fields, message, datagram in zip(packets, messages, datagrams, strict=True):
        assert shown(fields, "magic") == "NA"
        assert shown(fields, "version") == ("2" if encrypted else "1")
        assert shown(fields, "flow") == str(int(message.flow))
        assert shown(fields, "dimension") == str(len(message.vector))
        assert shown(fields, "error_level") == str(message.error_level)
        assert shown(fields, "loop") == str(message.loop)
        assert shown(fields, "run_id") == f"0x{RUN:016x}"
        assert shown(fields, "sequence") == str(message.sequence)
        assert shown(fields, "t_ns") == str(message.t_ns)
        assert fields["noack.tag"][0]["value"] == datagram[-TAG_BYTES:].hex()
        assert "noack.version.unknown" not in fields
        content = fields.get("noack.encrypted" if encrypted else "noack.vector", [])
        assert ("noack.vector" in fields) == (bool(content) and not encrypted)
        assert "".join(entry["value"] for entry in content) == datagram[HEADER_BYTES:-TAG_BYTES].hex()


WHOLE = Encoder(RUN, bytes(32)).encode(Message(Flow.UPDATE, 7, -5, np.ones(3)))


def with_byte(offset: int, value: int) -> bytes:
    return WHOLE[:offset] + bytes([value]) + WHOLE[offset + 1 :]


OTHERS = [b"", b"NA", WHOLE[: HEADER_BYTES - 1], with_byte(0, 0x4F), b"NA" + bytes(70)]
DAMAGED = [
    (WHOLE, []),
    (with_byte(2, 3), ["noack.version.unknown"]),
    (with_byte(3, 9), ["noack.flow.unknown"]),
    (with_byte(4, 2), ["noack.length.wrong"]),
    (WHOLE[:-1], ["noack.length.wrong"]),
    (WHOLE + b"\0", ["noack.length.wrong"]),
    (WHOLE[:HEADER_BYTES], ["noack.length.wrong"]),
]


def test_a_damaged_datagram_is_shown_with_its_fault(tshark: Tshark, tmp_path: Path) -> None:
    """Other protocols are not dissected."""
    packets = dissected(tshark, tmp_path, *OTHERS, *(payload for payload, _ in DAMAGED))
    for fields in packets[: len(OTHERS)]:
        assert not any(name.startswith("noack") for name in fields)
    for fields, (_, faults) in zip(packets[len(OTHERS) :], DAMAGED, strict=True):
        assert shown(fields, "sequence") == "7"
        shown_faults = [n for n in fields if n.endswith((".unknown", ".wrong")) and "noack" in n]
        assert shown_faults == faults
        assert ("noack.vector" in fields) == (faults != ["noack.length.wrong"])


@pytest.mark.skipif(shutil.which("tshark") is None, reason="tshark is not installed")
def test_the_documented_command_shows_the_packet_list(tshark: Tshark, tmp_path: Path) -> None:
    (command,) = re.findall(r"^```sh\n(.*?)\n```", (DOCS / "wire.md").read_text(), re.DOTALL | re.M)
    (tmp_path / "docs").symlink_to(DOCS)
    encoder = Encoder(RUN, bytes(32))
    messages = [Message(Flow(1 + k % 3), k, k * 10**9 - 2, np.array([k - 5.0, 0.5])) for k in range(6)]
    path = capture_of(tmp_path, *map(encoder.encode, messages))
    done = subprocess.run(
        shlex.split(command), cwd=tmp_path, capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.splitlines() == [
        "40002\t1\t999999998\t-4,0.5",
        "40002\t4\t3999999998\t-1,0.5",
    ]
    script = ("-X", f"lua_script:{DOCS / 'noack.lua'}", "-Y", "noack.t_ns < 1000000000")
    columns = ("-T", "fields", "-e", "_ws.col.Protocol", "-e", "_ws.col.Info")
    assert tshark(path, *script, *columns).splitlines() == [
        "noack\tmeasurement #0 t=-0.000000002 s",
        "noack\tupdate #1 t=0.999999998 s",
    ]
