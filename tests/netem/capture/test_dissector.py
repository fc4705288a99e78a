"""``docs/noack.lua`` in tshark, over datagrams of :mod:`noack.protocol.wire_format`."""

import math
import re
import shlex
import shutil
import struct
import subprocess
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from noack.protocol.wire_format import HEADER_BYTES, TAG_BYTES, Encoder, Flow, Message
from tests.netem.capture.batches import file_of
from tests.netem.capture.conftest import Tshark

DOCS = Path(__file__).parents[3] / "docs"
SCRIPT = DOCS / "noack.lua"
RUN = 0x0123_4567_89AB_CDEF
Fields = dict[str, list[dict[str, str]]]
Dissect = Callable[..., list[Fields]]


@pytest.fixture
def dissect(tshark: Tshark, tmp_path: Path) -> Dissect:
    """Return tshark's fields of each payload: ``show`` as text, ``value`` as hex."""

    def run(*payloads: bytes) -> list[Fields]:
        return fields_of(tshark, capture_of(tmp_path, *payloads))

    return run


def capture_of(folder: Path, *payloads: bytes) -> Path:
    path = folder / "capture.pcapng"
    path.write_bytes(file_of(*({"payload": payload} for payload in payloads)))
    return path


def fields_of(tshark: Tshark, path: Path) -> list[Fields]:
    packets = []
    text = tshark(path, "-X", f"lua_script:{SCRIPT}", "-T", "pdml")
    for packet in ET.fromstring(text).iter("packet"):
        fields: Fields = {}
        for field in packet.iter("field"):
            fields.setdefault(field.attrib["name"], []).append(field.attrib)
        packets.append(fields)
    return packets


def encoded(
    flow: Flow, sequence: int, t_ns: int, vector: list[float], run_id: int = RUN, loop: int = 0
) -> bytes:
    encoder = Encoder(run_id, bytes(32))
    return encoder.encode(Message(flow, sequence, t_ns, np.array(vector), loop))


def shown(fields: Fields, name: str) -> str:
    (field,) = fields[f"noack.{name}"]
    return field["show"]


def test_every_field_is_shown(dissect: Dissect) -> None:
    messages = [
        {"flow": Flow.UPDATE, "sequence": 2**64 - 1, "t_ns": -1, "run_id": 2**64 - 1,
         "vector": [-0.0, 5e-324, -1.5e308]},
        {"flow": Flow.ACTUATION, "sequence": 0, "t_ns": -(2**63), "run_id": 0, "vector": [1.0]},
        {"flow": Flow.MEASUREMENT, "sequence": 1, "t_ns": 2**63 - 1, "run_id": 1,
         "vector": [0.1] * 64, "loop": 2**16 - 1},
        {"flow": Flow.ACKNOWLEDGEMENT, "sequence": 17, "t_ns": 1_234_000_000, "run_id": RUN,
         "vector": []},
    ]  # fmt: skip
    datagrams = [encoded(**message) for message in messages]
    for fields, message, datagram in zip(dissect(*datagrams), messages, datagrams, strict=True):
        assert shown(fields, "magic") == "NA"
        assert shown(fields, "version") == "1"
        assert shown(fields, "flow") == str(int(message["flow"]))
        assert shown(fields, "dimension") == str(len(message["vector"]))
        assert shown(fields, "loop") == str(message.get("loop", 0))
        assert shown(fields, "run_id") == f"0x{message['run_id']:016x}"
        assert shown(fields, "sequence") == str(message["sequence"])
        assert shown(fields, "t_ns") == str(message["t_ns"])
        assert fields["noack.tag"][0]["value"] == datagram[-TAG_BYTES:].hex()
        vector = fields.get("noack.vector", [])
        assert [entry["value"] for entry in vector] == [
            struct.pack("<d", entry).hex() for entry in message["vector"]
        ]
        # Wireshark shows 15 significant digits.
        for entry, number in zip(vector, message["vector"], strict=True):
            assert math.isclose(float(entry["show"]), number, rel_tol=1e-14)


def test_an_encrypted_vector_is_shown_as_bytes(dissect: Dissect) -> None:
    encoder = Encoder(RUN, bytes(32), encrypted=True)
    messages = [
        Message(Flow.UPDATE, 3, 0, np.array([1.0, -2.0])),
        Message(Flow.ACKNOWLEDGEMENT, 3, 0, np.zeros(0)),
    ]
    datagrams = [encoder.encode(message) for message in messages]
    for fields, data in zip(dissect(*datagrams), datagrams, strict=True):
        assert shown(fields, "version") == "2"
        assert "noack.version.unknown" not in fields
        assert "noack.vector" not in fields
        hidden = [field["value"] for field in fields.get("noack.encrypted", [])]
        assert "".join(hidden) == data[HEADER_BYTES:-TAG_BYTES].hex()
        assert fields["noack.tag"][0]["value"] == data[-TAG_BYTES:].hex()


WHOLE = encoded(Flow.UPDATE, 7, 5, [1.0, 2.0, 3.0])


def with_byte(offset: int, value: int) -> bytes:
    return WHOLE[:offset] + bytes([value]) + WHOLE[offset + 1 :]


DAMAGED = [
    (WHOLE, []),
    (with_byte(2, 3), ["noack.version.unknown"]),
    (with_byte(3, 9), ["noack.flow.unknown"]),
    *(
        (payload, ["noack.length.wrong"])
        for payload in (with_byte(4, 2), WHOLE[:-1], WHOLE + b"\0", WHOLE[:HEADER_BYTES])
    ),
]
OTHERS = [b"", b"NA", WHOLE[: HEADER_BYTES - 1], with_byte(0, 0x4F), b"NA" + bytes(70)]


def test_a_damaged_datagram_is_shown_with_its_fault(dissect: Dissect) -> None:
    """Other protocols are not dissected."""
    packets = dissect(*OTHERS, *(payload for payload, _ in DAMAGED))
    for fields in packets[: len(OTHERS)]:
        assert not any(name.startswith("noack") for name in fields)
    for fields, (_, faults) in zip(packets[len(OTHERS) :], DAMAGED, strict=True):
        assert shown(fields, "sequence") == "7"
        found = [n for n in fields if n.endswith((".unknown", ".wrong")) and "noack" in n]
        assert found == faults
        assert ("noack.vector" in fields) == (faults != ["noack.length.wrong"])


@pytest.mark.skipif(shutil.which("tshark") is None, reason="tshark is not installed")
def test_the_documented_command_works(tmp_path: Path) -> None:
    (command,) = re.findall(r"^```sh\n(.*?)\n```", (DOCS / "wire.md").read_text(), re.DOTALL | re.M)
    (tmp_path / "docs").symlink_to(DOCS)
    payloads = [encoded(Flow(1 + i % 3), i, i * 10**9, [i - 5.0, 0.5]) for i in range(6)]
    capture_of(tmp_path, *payloads)
    done = subprocess.run(
        shlex.split(command), cwd=tmp_path, capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.splitlines() == [
        "40002\t1\t1000000000\t-4,0.5",
        "40002\t4\t4000000000\t-1,0.5",
    ]


INFO = [
    (Flow.MEASUREMENT, 0, 0, "measurement #0 t=0 s"),
    (Flow.UPDATE, 17, 1_234_000_000, "update #17 t=1.234 s"),
    (Flow.ACTUATION, 2**64 - 1, -5_100_000_000, f"actuation #{2**64 - 1} t=-5.1 s"),
    (Flow.UPDATE, 1, -1, "update #1 t=-0.000000001 s"),
    (Flow.UPDATE, 1, 2**63 - 1, "update #1 t=9223372036.854775807 s"),
    (Flow.UPDATE, 1, -(2**63), "update #1 t=-9223372036.854775808 s"),
]


def test_the_packet_list_shows_flow_number_and_time_and_can_be_filtered(
    tshark: Tshark, tmp_path: Path
) -> None:
    payloads = [encoded(*message, [k - 2.0]) for k, (*message, _) in enumerate(INFO)]
    path = capture_of(tmp_path, *payloads)

    def shown(condition: str) -> list[str]:
        columns = ("-e", "_ws.col.Protocol", "-e", "_ws.col.Info")
        script = ("-X", f"lua_script:{SCRIPT}")
        return tshark(path, *script, "-Y", condition, "-T", "fields", *columns).splitlines()

    assert shown("noack") == [f"noack\t{info}" for *_, info in INFO]
    assert len(shown('noack.flow == "update" and noack.t_ns < 0')) == 2
    assert len(shown(f"noack.run_id == {RUN:#x} and (noack.flow == 3 or noack.vector < -1.5)")) == 2
