"""Opens the view of a finished run at the time of the largest ‖e_c‖.

Neither a layout in a recording nor the address of a recording can set rerun's time cursor; only
requests to a running viewer can. The web viewer accepts a protobuf message
``ViewerControlRequest``, the window accepts the requests of rerun's client.
"""

import re
import subprocess
import time
from pathlib import Path
from typing import IO, Any

from cosim.analysis.network_summary import worst_loop
from cosim.analysis.summary_model import read_summary
from cosim.output.viewer.pictures.picture import TIMELINE
from cosim.output.viewer.rerun_program import logged_port
from cosim.record.run_directory import (
    RECORDING_FILE,
    SUMMARY_FILE,
    loop_of_file,
    read_object,
)
from noack.core.clock import NS_PER_S

_RETRY_S = 0.25
_START_S = 60.0
_TAKES_REQUESTS_AT = re.compile(rb"rerun\+http://127\.0\.0\.1:(\d+)")
_SET_TIME_CURSOR, _TIMELINE, _TIME, _PLAY_STATE, _FIRST = 6, 2, 3, 5, 1
"""Numbers of the message's fields; nested messages have only a first field."""
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
    """Return the time of the largest ‖e_c‖ from the recording's summary; None without a summary.

    In the recording of the run, it is that of the worst loop.
    """
    name = loop_of_file(recording.name, RECORDING_FILE)
    summary = read_summary(read_object(recording.parent / SUMMARY_FILE))
    if summary is None or name not in (None, *(one.name for one in summary.loops)):
        return None
    loops = {one.number: one for one in summary.loops if name in (None, one.name)}
    loop = loops[worst_loop([*loops.values()]).number]
    if loop.sup_e_c_at_s is None:
        return None
    begin_s = loop.phase_s if name is None else 0.0
    return round((begin_s + loop.sup_e_c_at_s) * NS_PER_S)


def script_to_open_at(t_ns: int) -> bytes:
    """Return HTML for the web viewer's page: it moves the cursor once the recording is loaded."""
    request = list(_request(t_ns))
    return _SCRIPT.format(retry_ms=round(1e3 * _RETRY_S), request=request).encode()


def move_window_to(t_ns: int, window: "subprocess.Popen[Any]", output: IO[bytes]) -> None:
    """Move the cursor of a window once the recording is loaded, unless the window closes before.

    Args:
        t_ns: time on the recording's timeline.
        window: the viewer's process.
        output: its log, which contains the address at which it accepts requests.
    """
    from rerun.experimental import ViewerClient

    with output:
        port = logged_port(window, output, _TAKES_REQUESTS_AT, _START_S)
    while port is not None and window.poll() is None:
        try:
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            client.set_time(TIMELINE, duration=t_ns / NS_PER_S, play_state="paused")
        except OSError:  # it is still loading
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
    """Return a length-delimited field in protobuf's encoding."""
    return _varint(field << 3 | 2) + _varint(len(content)) + content


def _number(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def _varint(value: int) -> bytes:
    low, rest = value & 0x7F, value >> 7
    return bytes([low | 0x80]) + _varint(rest) if rest else bytes([low])
