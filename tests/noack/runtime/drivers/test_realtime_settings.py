"""Real-time settings: priorities."""

import os
import threading
from contextlib import ExitStack

import pytest

from noack.runtime.drivers.realtime_settings import _fifo


@pytest.mark.skipif(not hasattr(os, "sched_setscheduler"), reason="Linux")
@pytest.mark.parametrize(("priority", "expected"), [(50, [47, 48, 49, 50]), (1, [1, 1, 1, 1])])
def test_a_receiver_interrupts_its_sender_and_the_loop_the_other_threads(
    priority: int, expected: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[tuple[int, int]] = []

    def note(thread: int, _policy: int, parameters: os.sched_param) -> None:
        given.append((thread, parameters.sched_priority))

    monkeypatch.setattr(os, "sched_setscheduler", note)
    for place, own in enumerate(expected):
        given.clear()
        with ExitStack() as undo:
            _fifo(priority, place, undo)
        first, *others, last = given
        assert (first, last) == ((threading.get_native_id(), own), (0, 0))
        assert {rank for _, rank in others} <= {max(priority - 4, 1)}
