"""tshark reads and filters a capture."""

import ipaddress
import random
from pathlib import Path
from typing import Any

from tests.netem.capture.batches import INTERFACES, T_NS, file_of
from tests.netem.capture.conftest import Tshark

GOOD = "1"
SIZES = [0, 1, 2, 3, 1472, 65_507]


def fields(tshark: Tshark, path: Path, *names: str) -> list[list[str]]:
    chosen = [word for name in names for word in ("-e", name)]
    lines = tshark(path, "-T", "fields", "-E", "occurrence=f", *chosen).splitlines()
    return [line.split("\t") for line in lines]


def random_event(rng: random.Random, family: int, size: int) -> dict[str, Any]:
    address = ipaddress.IPv4Address if family == 4 else ipaddress.IPv6Address
    departure = rng.randrange(2)
    return {
        "t_ns": T_NS + rng.randrange(10**10), "interface": rng.randrange(2),
        "departure": departure, "fate": rng.randrange(6), "consecutive_losses": rng.randrange(3),
        "family": family, "source": str(address(rng.randbytes(4 if family == 4 else 16))),
        "destination": str(address(rng.randbytes(4 if family == 4 else 16))),
        # Ports without a Wireshark dissector: these tests do not cover payloads.
        "source_port": rng.randrange(50_000, 65_536),
        "destination_port": rng.randrange(50_000, 65_536),
        "payload": rng.randbytes(size),
    }  # fmt: skip


def test_tshark_reads_all_that_was_written(tshark: Tshark, tmp_path: Path) -> None:
    rng = random.Random(1)
    described = [
        random_event(rng, family, size)
        for family in (4, 6)
        for size in [*SIZES, *(rng.randrange(200) for _ in range(20))]
    ]
    path = tmp_path / "capture.pcapng"
    path.write_bytes(file_of(*described))
    rows = fields(
        tshark, path,
        "frame.time_epoch", "frame.interface_name", "frame.packet_flags_direction",
        "ip.src", "ip.dst", "ipv6.src", "ipv6.dst", "udp.srcport", "udp.dstport", "udp.length",
        "ip.checksum.status", "udp.checksum.status", "udp.payload",
    )  # fmt: skip
    assert len(rows) == len(described)
    for row, event in zip(rows, described, strict=True):
        seconds, nanoseconds = divmod(event["t_ns"], 10**9)
        ip = [event["source"], event["destination"]]
        assert row == [
            f"{seconds}.{nanoseconds:09d}",
            INTERFACES[event["interface"]][0],
            "0x00000002" if event["departure"] else "0x00000001",
            *(ip if event["family"] == 4 else ["", ""]),
            *(ip if event["family"] == 6 else ["", ""]),
            str(event["source_port"]),
            str(event["destination_port"]),
            str(len(event["payload"]) + 8),
            GOOD if event["family"] == 4 else "",
            GOOD,
            event["payload"].hex(),
        ]


def test_tshark_filters_by_fate_flow_and_datagram(tshark: Tshark, tmp_path: Path) -> None:
    path = tmp_path / "capture.pcapng"
    path.write_bytes(
        file_of(
            {"flow": 3, "packet": 1}, {"flow": 33, "packet": 1},
            {"flow": 3, "packet": 2, "fate": 1, "consecutive_losses": 1, "mansd": 4},
            {"flow": 3, "packet": 1, "interface": 1, "departure": 1, "delay_ns": 1_500_000},
        )
    )  # fmt: skip
    lost = tshark(
        path, "-Y", 'frame.comment contains "dropped"', "-T", "fields", "-e", "frame.number"
    )
    assert lost.split() == ["3"]
    flow = tshark(
        path, "-Y", 'frame.comment contains "flow 3,"', "-T", "fields", "-e", "frame.number"
    )
    assert flow.split() == ["1", "3", "4"]
    rows = fields(tshark, path, "frame.packet_id", "frame.comment", "frame.interface_description")
    assert rows[0][0] == rows[3][0] != rows[2][0]
    assert rows[2][1:] == [
        "dropped by the loss model, consecutive loss 1, cap 4; forward, flow 3, packet 2",
        INTERFACES[0][1],
    ]
    assert rows[3][1] == "delivered, after 1.5 ms; forward, flow 3, packet 1"
