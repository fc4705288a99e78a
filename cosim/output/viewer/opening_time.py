"""The time at which a finished run's view opens: that of the largest ‖e_c‖.

A layout in a recording cannot set rerun's time cursor, nor can the address of a recording; only
requests to a running viewer do. The web viewer takes a protobuf message ``ViewerControlRequest``,
the window what rerun's client sends.
"""

import json
import re
import subprocess
import time
from pathlib import Path
from typing import IO, Any

from cosim.output.viewer.pictures.picture import TIMELINE
from cosim.output.viewer.rerun_program import logged_port
from cosim.record.run_directory import SUMMARY_FILE
from noack.core.clock import NS_PER_S

_RETRY_S = 0.25
_START_S = 60.0
_TAKES_REQUESTS_AT = re.compile(rb"rerun\+http://127\.0\.0\.1:(\d+)")
_SET_TIME_CURSOR, _TIMELINE, _TIME, _PLAY_STATE, _FIRST = 6, 2, 3, 5, 1
"""Numbers of the message's fields; those of nested messages have only a first."""
_PAUSED = 1
_SCRIPT = """<script>
(function openAt() {{
  const retry = () => setTimeout(openAt, {retry_ms});
  if (window._handle === undefined) return retry();
  window._handle.viewer_control(new Uint8Array({request})).catch(retry);
}})();
</script>
"""


def opening_time_ns(recording: Path) -> int | None:
    """Time of the largest ‖e_c‖ by the summary beside a recording; None while there is none."""
    try:
        summary: Any = json.loads((recording.parent / SUMMARY_FILE).read_text(encoding="utf-8"))
        at_s: float = summary["sup_e_c_at_s"]
        return round(at_s * NS_PER_S)
    except (OSError, ValueError, KeyError, TypeError):
        return None


def script_to_open_at(t_ns: int) -> bytes:
    """HTML for the web viewer's page: it moves the cursor as soon as the recording is there."""
    request = list(_request(t_ns))
    return _SCRIPT.format(retry_ms=round(1e3 * _RETRY_S), request=request).encode()


def move_window_to(t_ns: int, window: "subprocess.Popen[Any]", output: IO[bytes]) -> None:
    """Move the cursor of a window as soon as the recording is there, unless it closes before.

    Args:
        t_ns: time on the recording's timeline.
        window: the viewer's process.
        output: what it logs, the address at which it takes requests included.
    """
    from rerun.experimental import ViewerClient

    with output:
        port = logged_port(window, output, _TAKES_REQUESTS_AT, _START_S)
    while port is not None and window.poll() is None:
        try:
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            client.set_time(TIMELINE, duration=t_ns / NS_PER_S, play_state="paused")
        except OSError:  # it loads
            time.sleep(_RETRY_S)
        else:
            return


def _request(t_ns: int) -> bytes:
    cursor = (
        _message(_TIMELINE, _message(_FIRST, TIMELINE.encode()))
        + _message(_TIME, _number(_FIRST, t_ns))
        + _number(_PLAY_STATE, _PAUSED)
    )
    return _message(_SET_TIME_CURSOR, cursor)


def _message(field: int, content: bytes) -> bytes:
    """A field with a length, in protobuf's encoding."""
    return _varint(field << 3 | 2) + _varint(len(content)) + content


def _number(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def _varint(value: int) -> bytes:
    low, rest = value & 0x7F, value >> 7
    return bytes([low | 0x80]) + _varint(rest) if rest else bytes([low])
