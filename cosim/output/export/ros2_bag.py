"""A run as ROS 2 messages in MCAP (profile ``ros2``): CDR, with ``ros2msg`` schemas.

It is a file of its own, beside the one with JSON: rosbags and ``ros2 bag`` read files in which
every channel is of ROS 2. Log time, publish time and topics are those of
:mod:`cosim.output.export.mcap_export`; the stamp in a message is its nominal time.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from cosim.output.export import ExportedRun
from noack.core.file_access import new_file
from noack.protocol import ros2_messages as ros2

if TYPE_CHECKING:
    from mcap.writer import Writer

SUFFIX = ".ros2.mcap"
_LEVELS = {"warning": 30, "restart": 30, "error": 40}
_INFO = 20


def write(run: ExportedRun, path: Path) -> Path:
    """Write the file beside the one with JSON; return its path. Raise OSError if that fails."""
    from mcap.writer import CompressionType, Writer  # an extra, whose absence the caller reports

    path = path.with_suffix(SUFFIX)
    with new_file(path) as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="noack")
        bag = _Bag(writer)
        loops = run.inner or [run]
        for loop in loops:
            bag.write_loop(loop, is_only=len(loops) == 1)
        bag.write_log(run)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


class _Bag:
    def __init__(self, writer: "Writer") -> None:
        self._writer, self._channels, self._schemas = writer, dict[str, int](), dict[str, int]()

    def _channel(self, topic: str, kind: str) -> int:
        if topic not in self._channels:
            if kind not in self._schemas:
                content = ros2.definition(kind).encode()
                self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", content)
            profile = {"offered_qos_profiles": ""}
            self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schemas[kind], profile)
        return self._channels[topic]

    def write_loop(self, run: ExportedRun, *, is_only: bool) -> None:
        """Write the messages of a loop, each part of its record in the order of the log time."""
        record = run.record
        loop, name = record.loop, record.scenario.name
        prefix = ros2.namespace(run.name or name, is_only=is_only)
        for part in record.slices(*ros2.TOPICS):
            found: list[tuple[int, int, str, bytes, int]] = []
            for table in ros2.TOPICS:
                rows = part[table]
                for place, topic, entries in ros2.row_entries(
                    table, rows, loop.state_names, loop.input_names
                ):
                    log_ns = max(int(rows["now_ns"][place]) + run.phase_ns, 0)
                    stamped = entries._replace(stamp_ns=entries.stamp_ns + run.phase_ns)
                    number = int(rows["sequence"][place]) & 0xFFFF_FFFF
                    message = ros2.joint_state(stamped, name)
                    found.append((log_ns, stamped.stamp_ns, f"{prefix}/{topic}", message, number))
            self._add(sorted(found, key=lambda message: message[0]))

    def _add(self, found: Iterable[tuple[int, int, str, bytes, int]]) -> None:
        for log_ns, publish_ns, topic, message, number in found:
            channel = self._channel(topic, ros2.JOINT_STATE)
            self._writer.add_message(channel, log_ns, message, max(publish_ns, 0), number)

    def write_log(self, run: ExportedRun) -> None:
        """Write the lines of the run's log to ``/rosout``."""
        for number, notice in enumerate(run.record.notices):
            t_ns, level = max(int(notice["t_ns"]), 0), _LEVELS.get(notice["level"], _INFO)
            line = ros2.log_line(t_ns, level, notice["process"], notice["text"])
            channel = self._channel("/rosout", ros2.LOG)
            self._writer.add_message(channel, t_ns, line, t_ns, number)
