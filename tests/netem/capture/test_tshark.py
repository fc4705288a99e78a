"""tshark reads and filters a capture."""

from pathlib import Path

from tests.netem.capture.batches import INTERFACES, T_NS, USUAL, file_of
from tests.netem.capture.conftest import Tshark

IPV6 = {"family": 6, "source": "2001:db8::1", "destination": "2001:db8::2"}
EVENTS = [
    {"flow": 3, "packet": 1, "payload": b""},
    {"flow": 33, "packet": 1, "payload": bytes(range(250))},
    {"flow": 3, "packet": 2, "fate": 1, "consecutive_losses": 1, "mansd": 4} | IPV6,
    {"flow": 3, "packet": 1, "interface": 1, "departure": 1, "delay_ns": 1_500_000},
    {"flow": 4, "packet": 1, "payload": bytes(65_507)} | IPV6,
]
FIELDS = (
    "frame.time_epoch", "frame.interface_name", "frame.interface_description",
    "frame.packet_flags_direction", "ip.src", "ip.dst", "ipv6.src", "ipv6.dst", "udp.srcport",
    "udp.dstport", "udp.length", "ip.checksum.status", "udp.checksum.status", "udp.payload",
)  # fmt: skip
GOOD = "1"


def test_tshark_reads_and_filters_what_was_written(tshark: Tshark, tmp_path: Path) -> None:
    path = tmp_path / "capture.pcapng"
    path.write_bytes(file_of(*EVENTS))

    def fields(*names: str, where: str = "") -> list[list[str]]:
        chosen = [word for name in names for word in ("-e", name)]
        lines = tshark(path, "-Y", where, "-T", "fields", "-E", "occurrence=f", *chosen)
        return [line.split("\t") for line in lines.splitlines()]

    for row, given in zip(fields(*FIELDS), EVENTS, strict=True):
        event = USUAL | given
        ends = [event["source"], event["destination"]]
        is_ipv4 = event["family"] == 4
        assert row == [
            f"{T_NS // 10**9}.{T_NS % 10**9:09d}",
            *INTERFACES[event.get("interface", 0)],
            "0x00000002" if event.get("departure") else "0x00000001",
            *(ends if is_ipv4 else ["", ""]),
            *(["", ""] if is_ipv4 else ends),
            str(event["source_port"]),
            str(event["destination_port"]),
            str(len(event["payload"]) + 8),
            GOOD if is_ipv4 else "",
            GOOD,
            event["payload"].hex(),
        ]
    flow_3 = fields("frame.number", "frame.packet_id", where='frame.comment contains "flow 3,"')
    assert [number for number, _ in flow_3] == ["1", "3", "4"]
    assert flow_3[0][1] == flow_3[2][1] != flow_3[1][1]
    assert fields("frame.comment", where='frame.comment contains "dropped"') == [
        ["dropped by the loss model, consecutive loss 1, cap 4; forward, flow 3, packet 2"]
    ]
