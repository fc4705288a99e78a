import os
import subprocess
import sys
import threading
from contextlib import ExitStack

import pytest

from noack.runtime.real_time_loop import _fifo

_PROGRAM = """
import os, sys
from noack.runtime.real_time_loop import realtime
with realtime(True, int(sys.argv[1]), int(sys.argv[2])) as applied:
    if {applied["sched_fifo"], applied["affinity"]} != {"applied"}:
        sys.exit("skip: SCHED_FIFO needs a privilege, pinning two cores")
    print(os.sched_getparam(0).sched_priority, *os.sched_getaffinity(0))
"""


def _applied(priority: int, place: int) -> tuple[int, ...]:
    command = [sys.executable, "-c", _PROGRAM, str(priority), str(place)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.stderr.startswith("skip"):
        pytest.skip(done.stderr)
    return tuple(map(int, done.stdout.split()))


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="Linux")
def test_receiver_interrupts_its_sender_on_the_same_core() -> None:
    (plant, *plant_cores), *others = [_applied(50, place) for place in range(4)]
    priorities = [plant, *(priority for priority, *_ in others)]
    assert priorities == [47, 48, 49, 50]
    assert len({tuple(cores) for _, *cores in others}) == 1
    assert plant_cores != others[0][1:]


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="Linux")
def test_lowest_priority_is_1() -> None:
    assert [_applied(1, place)[0] for place in range(4)] == [1, 1, 1, 1]


@pytest.mark.skipif(not hasattr(os, "sched_setscheduler"), reason="Linux")
def test_other_threads_stay_normal_if_the_loop_may_not_be_real_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """RLIMIT_RTPRIO may permit their lower priority only."""
    priorities = []

    def limited(_thread: int, _policy: int, parameters: os.sched_param) -> None:
        if parameters.sched_priority > 46:
            raise PermissionError(1, "Operation not permitted")
        priorities.append(parameters.sched_priority)

    monkeypatch.setattr(os, "sched_setscheduler", limited)
    ended = threading.Event()
    other = threading.Thread(target=ended.wait)
    other.start()
    try:
        with ExitStack() as undo, pytest.raises(PermissionError):
            _fifo(50, 1, undo)
    finally:
        ended.set()
        other.join()
    assert priorities == []
