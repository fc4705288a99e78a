"""The recorder's process: drives a recorder to the end of its run; a live viewer on request."""

import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from cosim.live.telemetry_recorder import Recorder
from cosim.record.decimate import is_long
from cosim.record.run_directory import RECORDING_FILE, active_run
from noack.core.core_library import core
from noack.core.errors import ExitStatus, MachineError
from noack.protocol.machine_interface import RESTART, Notice
from noack.protocol.topology import RECORDER
from noack.runtime.command_line import print_to_stderr
from noack.runtime.life_cycle import LAUNCHER_GONE
from noack.runtime.process_entry import run_process
from noack.runtime.process_life import RunProcess

if TYPE_CHECKING:
    from cosim.output.viewer.live_viewer import LiveView
    from cosim.output.viewer.network_recording import NetworkRecording
    from cosim.output.viewer.recording import RunView

_POLL_S = 0.02
_SHOW_S = 0.1
_ACKNOWLEDGE_S = 1.0
_STOP_TIMEOUT_S = 8.0


def main(arguments: Sequence[str] | None = None) -> ExitStatus:
    """Run the recorder; ``--live`` also opens a viewer."""
    live = "--live" in (sys.argv[1:] if arguments is None else arguments)

    def body(process: RunProcess) -> None:
        with active_run(Path(process.ticket.run_dir)), ExitStack() as stack:
            live_view = None
            if live and not process.start.is_restart:
                from cosim.output.viewer.live_viewer import LiveView

                live_view = LiveView()
                stack.callback(live_view.close)  # it would not exit by itself
            _record(process, live_view)

    return run_process(RECORDER, body)


def _record(process: RunProcess, live_view: "LiveView | None") -> None:
    """Record a run to its end."""
    run_dir = Path(process.ticket.run_dir)
    # A live view is ready when the run begins. The libraries of a recording take half a second to
    # load: the other processes do not wait for them.
    view = _open_view(process, live_view) if live_view else None
    status = live_view.status if live_view else None
    recorder = Recorder(process.scenario, run_dir, process.plane, status, start=process.start)
    if process.replaces is not None:
        recorder.note(Notice(process.start.from_ns, RESTART, f"restarted: {process.replaces}"))
    process.join(None)
    core.noack_prefer_others()  # without real-time settings, the loop would wait for milliseconds
    # The launcher writes the view of a restarted recorder, of a long run, and of several loops.
    unseen = len(process.phases_ns) > 1 or is_long(process.scenario)
    if view is not None or not (process.start.is_restart or unseen):
        try:
            view = view or _open_view(process, None)
            recorder.show_in(view)
        except MachineError as error:
            recorder.give_up_view(error)
    if not _poll_to_the_end(process, recorder):
        # The other processes spool their last rows now; `noack summary` completes the record.
        recorder.abandon()
        if view is not None:
            view.close()
        return
    while recorder.poll():
        pass
    if silent := recorder.without_report:
        print_to_stderr(f"noack recorder: no report from {', '.join(silent)}")
    recorder.show()
    recorder.finish()
    try:
        if view is not None:
            view.close()
    except MachineError as error:
        print_to_stderr(f"noack recorder: {error}; the numeric record is complete")
    if recorder.view_is_incomplete or unseen:
        (run_dir / RECORDING_FILE).unlink(missing_ok=True)  # the launcher writes another one
    recorder.report()
    if recorder.lost is not None:
        raise recorder.lost


def _open_view(process: RunProcess, live_view: "LiveView | None") -> "RunView | NetworkRecording":
    scenario, run_id, run_dir = process.scenario, process.ticket.run_id, process.ticket.run_dir
    from cosim.output.viewer.run_view import open_view

    return open_view(scenario, Path(run_dir), run_id, live_view)


def _poll_to_the_end(process: RunProcess, recorder: Recorder) -> bool:
    """Receive until all processes have handed over their rows, or the recorder must stop.

    Returns:
        Whether the record can be completed now; not when the launcher has ended early.
    """
    shown_s = stop_s = None
    acknowledged_s = time.monotonic()
    while not recorder.finished:
        more = recorder.poll()
        if process.stopping:
            recorder.end_monitoring()
        for change, announcement in process.updates.take():
            recorder.change(change, announcement)
        now_s = time.monotonic()
        if shown_s is None or now_s - shown_s >= _SHOW_S:
            recorder.show()
            shown_s = now_s
        if now_s - acknowledged_s >= _ACKNOWLEDGE_S:
            recorder.acknowledge()
            acknowledged_s = now_s
        if process.stopping:
            if process.ended == LAUNCHER_GONE:
                return False
            stop_s = stop_s or now_s
            if process.ended in ("SIGINT", "SIGTERM") or now_s - stop_s > _STOP_TIMEOUT_S:
                return True
        if not more:
            time.sleep(_POLL_S)
    return True


if __name__ == "__main__":
    sys.exit(main())
