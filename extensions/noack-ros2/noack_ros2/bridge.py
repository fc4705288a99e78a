"""Sends the rows of a live run to the graph of ROS 2.

The bridge is a process of its own, beside the run: it receives what the processes send to the
recorder anyway. So the loop does not wait for it, and neither knows of it. A batch of rows has up to
50 ms; its messages are sent when it arrives, each topic in order, each message with its own stamp.
"""

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from noack import RunObserver, follow
from noack.extend import CallerError, NoackError
from noack_ros2 import ros2_messages as ros2
from noack_ros2.ros2_node import Node, Publisher

_END_S = 10.0
"""Time for the bridge to end."""
_READY = "ready\n"


def publish_run(run_dir: Path, node: Node) -> int:
    """Publish state, input, update and event of each loop of a run to its end.

    Returns:
        The number of messages.

    Raises:
        NoackError: the run does not start in time, or cannot be reached.
    """
    run, sent = follow(run_dir), 0
    topics = [topic for names in ros2.TOPICS.values() for topic in names]
    publishers: dict[str, dict[str, Publisher]] = {}
    for loop in run.loops:
        prefix = ros2.namespace(loop.name, is_only=len(run.loops) == 1)
        publishers[loop.name] = {topic: node.publisher(f"{prefix}/{topic}") for topic in topics}
    for table, loop, rows in run.rows(*ros2.TOPICS):
        for _, topic, entries in ros2.row_entries(table, rows, loop.states, loop.inputs):
            stamped = entries._replace(stamp_ns=entries.stamp_ns + loop.phase_ns)
            publishers[loop.name][topic].publish(stamped, loop.name)
            sent += 1
    return sent


class RunBridge(RunObserver):
    """Tells the bridge's process which run it is to publish."""

    def __init__(self, process: "subprocess.Popen[str]") -> None:
        self._process = process

    def started(self, run_dir: Path) -> None:
        """Send the run directory."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{run_dir.resolve()}\n")
        self._process.stdin.flush()


@contextmanager
def bridge_process(router: str, domain: int, *, listen: bool) -> Iterator[RunBridge]:
    """Start the bridge's process within the context; yield the observer of its run.

    Raises:
        CallerError: it cannot join the graph of ROS 2.
    """
    words = [sys.executable, "-m", "noack_ros2.bridge", router, str(domain), str(int(listen))]
    pipe = subprocess.PIPE
    with subprocess.Popen(words, stdin=pipe, stdout=pipe, stderr=pipe, text=True) as process:
        assert process.stdout is not None
        if process.stdout.readline() != _READY:
            raise CallerError(process.communicate()[1].strip() or "the bridge did not start")
        try:
            yield RunBridge(process)
            sent, errors = process.communicate(timeout=_END_S)
        except subprocess.TimeoutExpired:
            sent, errors = "", "it did not end"
        finally:
            process.kill()
        text = errors.strip() or (f"{sent.strip()} messages" if sent.strip() else "it ended before the run")
        print(f"noack: bridge: {text}", file=sys.stderr)


def main() -> int:
    """Run the bridge: the run directory comes on standard input."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # it ends with the run
    router, domain, listen = sys.argv[1:]
    try:
        with Node("noack", router, int(domain), listen=listen == "1") as node:
            print(_READY, end="", flush=True)
            if run_dir := sys.stdin.readline().strip():
                print(publish_run(Path(run_dir), node), flush=True)
    except NoackError as error:
        print(error, file=sys.stderr)
        return int(error.exit_status)
    return 0


if __name__ == "__main__":
    sys.exit(main())
