"""Handing a process's rows over to the recorder, or else to the run directory's spool."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from noack.core.errors import PeerError
from noack.runtime.control_messages import MissingRows, PersistedAck, parse_message
from noack.runtime.control_plane import ControlPlane
from noack.runtime.spool import SPOOL, SpoolWriter
from noack.runtime.telemetry import NOTICES, TelemetryBuffer, first_row, notice_number, notices_of

_REPORT_TIMEOUT_S = 5.0
_REPORT_ATTEMPTS = 3


def persisted_rows(plane: ControlPlane, generation: int) -> Mapping[str, Sequence[tuple[int, int]]]:
    """Ranges of this process's rows that are on disk, by table; empty without a new message."""
    message = plane.persisted()
    if message is None:
        return {}
    try:
        acknowledged = parse_message(PersistedAck, message)
    except PeerError:  # not from the recorder
        return {}
    rows: Mapping[str, Sequence[tuple[int, int]]] = acknowledged["rows"]
    return rows if acknowledged["generation"] == generation else {}


def deliver_report(
    plane: ControlPlane, report: Mapping[str, object], telemetry: TelemetryBuffer
) -> bool:
    """Send the final report to the recorder, and again the rows that it misses.

    Return whether the recorder has everything.
    """
    try:
        for _ in range(_REPORT_ATTEMPTS):
            answer = plane.request("report", report, timeout_s=_REPORT_TIMEOUT_S)
            missing = parse_message(MissingRows, answer)["rows"]
            if not missing:
                return True
            telemetry.resend(missing, plane.publish_telemetry_blocking)
    except PeerError:
        pass
    return False


def spool_rows(run_dir: Path, role: str, writer: str, telemetry: TelemetryBuffer) -> None:
    """Write all rows that the buffer still holds to the spool; ``writer`` names its files."""
    spool = SpoolWriter(run_dir / SPOOL, writer)

    def append(table: str, header: bytes, payload: bytes) -> None:
        generation, first = first_row(header)
        if table == NOTICES:
            table, first = notices_of(role), notice_number(generation, first)
        spool.append(table, first, payload)

    telemetry.resend({table: [(0, n)] for table, n in telemetry.totals().items()}, append)
    spool.close()
