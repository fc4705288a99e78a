"""Sends the telemetry of a live run to the graph of ROS 2.

The bridge is a process of its own, beside the run: it receives what the processes send to the
recorder anyway, from the coordinator's router. So the loop does not wait for it, and neither knows
of it. A batch of telemetry has up to 50 ms; its messages are sent when it arrives, each topic in
order, each message with its own stamp.
"""

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO

import numpy as np
import zenoh
from zenoh.handlers import RingChannel

from cosim.live.monitoring.run_observers import RunObserver
from cosim.record.run_directory import SCENARIO_FILE
from noack.core.errors import CallerError, ExitStatus, NoackError, PeerError
from noack.core.system_processes import python_command
from noack.protocol import ros2_messages as ros2
from noack.protocol.record_tables import LOOP
from noack.protocol.ros2_node import Node, Publisher
from noack.runtime.active_runs import RUNS, OpenRun, active_runs, find_run
from noack.runtime.command_line import print_to_stderr
from noack.runtime.connections.zenoh_session import cause_of, header_of, open_session
from noack.scenario import scenario_file
from noack.scenario.resolution import loop_of, resolve_run, resolved_loops, run_tables
from noack.scenario.scenario import phases_ns

_WAITING_BATCHES = 4096
_POLL_S, _LOOK_S = 0.005, 0.5
"""Waits for rows, and for the end of the run."""
_START_S, _END_S = 30.0, 10.0
"""Time for the run to start, and for the bridge to end."""
_READY = "ready\n"


class Ros2Bridge:
    """Publishes state, input, update and event of each loop of a run.

    Args:
        node: in the graph of ROS 2.
        run_dir: the run directory, with the scenario.
    """

    def __init__(self, node: Node, run_dir: Path) -> None:
        scenario = resolve_run(scenario_file.load(run_dir / SCENARIO_FILE))
        self._types, self._phases_ns = run_tables(scenario), phases_ns(scenario)
        loops = resolved_loops(scenario)
        self._names = [loop.name for loop in loops]
        self._entries = [(loop_of(loop).state_names, loop_of(loop).input_names) for loop in loops]
        topics = [topic for names in ros2.TOPICS.values() for topic in names]
        self._publishers: list[dict[str, Publisher]] = [
            {topic: node.publisher(f"{prefix}/{topic}") for topic in topics}
            for prefix in (ros2.namespace(name, is_only=len(loops) == 1) for name in self._names)
        ]
        self.sent = 0
        """Number of published messages."""

    def take(self, sample: zenoh.Sample) -> None:
        """Publish what is in a batch of telemetry."""
        table = str(sample.key_expr).rpartition("/")[2]
        if table not in ros2.TOPICS or header_of(sample) is None:
            return
        rows = np.frombuffer(sample.payload.to_bytes(), self._types[table])
        for loop in np.unique(rows[LOOP]).tolist():
            own, phase_ns = rows[rows[LOOP] == loop], self._phases_ns[loop]
            for _, topic, entries in ros2.row_entries(table, own, *self._entries[loop]):
                stamped = entries._replace(stamp_ns=entries.stamp_ns + phase_ns)
                self._publishers[loop][topic].publish(stamped, self._names[loop])
                self.sent += 1


def bridge_run(run: OpenRun, node: Node) -> int:
    """Bridge an active run until it ends; return the number of messages.

    Raises:
        PeerError: the run cannot be reached.
        CallerError: its scenario cannot be read.
    """
    with _telemetry(run) as batches:
        bridge = Ros2Bridge(node, Path(run.run_dir))
        looked_s = time.monotonic()
        is_active = True
        while True:
            if (sample := batches.try_recv()) is not None:
                bridge.take(sample)
                continue
            if not is_active:
                return bridge.sent
            if time.monotonic() - looked_s > _LOOK_S:
                looked_s = time.monotonic()
                is_active = any(active.name == run.name for active in active_runs())
            time.sleep(_POLL_S)


@contextmanager
def _telemetry(run: OpenRun) -> "Iterator[zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]]]":
    with ExitStack() as stack:
        try:
            session = stack.enter_context(open_session(RUNS, run.name, listen=False))
        except zenoh.ZError as error:
            raise PeerError(f"{run.run_dir}: the run cannot be reached: {cause_of(error)}") from None
        key = f"noack/{run.name}/telemetry/*/*"
        yield session.declare_subscriber(key, RingChannel(_WAITING_BATCHES))


def wait_for_run(run_dir: Path, timeout_s: float) -> OpenRun:
    """Return the active run of a run directory, which may be about to start.

    Raises:
        CallerError: it is not active in time.
    """
    until_s = time.monotonic() + timeout_s
    while True:
        try:
            return find_run(run_dir=run_dir)
        except CallerError:
            if time.monotonic() > until_s:
                raise
            time.sleep(_POLL_S)


class _RunDirectory(RunObserver):
    """Writes the run directory of the run that it follows."""

    def __init__(self, file: IO[str]) -> None:
        self._file = file

    def started(self, run_dir: Path) -> None:
        """Write it."""
        self._file.write(f"{run_dir.resolve()}\n")
        self._file.flush()


@contextmanager
def bridge_process(router: str, domain: int, *, listen: bool) -> Iterator[RunObserver]:
    """Start the bridge's process within the context; yield what sends it the run directory.

    Raises:
        CallerError: it cannot join the graph of ROS 2; its process has printed why.
    """
    ros2.require_installed("noack bridge")
    words = python_command("-m", "cosim.live.monitoring.ros2_bridge", router, domain, int(listen))
    pipe = subprocess.PIPE
    with subprocess.Popen(words, stdin=pipe, stdout=pipe, stderr=pipe, text=True) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        if process.stdout.readline() != _READY:
            raise CallerError(process.communicate()[1].strip() or "the bridge did not start")
        try:
            yield _RunDirectory(process.stdin)
            sent, errors = process.communicate(timeout=_END_S)
        except subprocess.TimeoutExpired:
            sent, errors = "", "it did not end\n"
        finally:
            process.kill()
        errors = errors.strip() or ("" if sent.strip() else "it ended before the run")
        print_to_stderr(f"noack: bridge: {errors or f'{sent.strip()} messages'}")


def main() -> ExitStatus:
    """Run the bridge: the run directory comes on standard input."""
    router, domain, listen = sys.argv[1:]
    try:
        with Node("noack", router, int(domain), listen=listen == "1") as node:
            print(_READY, end="", flush=True)
            if run_dir := sys.stdin.readline().strip():
                print(bridge_run(wait_for_run(Path(run_dir), _START_S), node), flush=True)
    except NoackError as error:
        print(error, file=sys.stderr)
        return error.exit_status
    return ExitStatus.OK


if __name__ == "__main__":
    sys.exit(main())
