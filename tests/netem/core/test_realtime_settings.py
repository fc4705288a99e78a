"""Real-time settings: priorities, and the memory that is loaded before a run."""

import os
import threading
from contextlib import ExitStack
from pathlib import Path

import pytest

from netem.core import realtime_settings
from netem.core.realtime_settings import _mappings, _set_fifo_priority

READ, WRITE = 22, 23
"""MADV_POPULATE_READ and MADV_POPULATE_WRITE of Linux."""


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
            _set_fifo_priority(priority, place, len(expected), undo)
        first, *others, last = given
        assert (first, last) == ((threading.get_native_id(), own), (0, 0))
        assert {rank for _, rank in others} <= {max(priority - 4, 1)}


@pytest.mark.parametrize(
    ("rights", "shared_dirty_kb", "advice"),
    [("r-xp", 0, READ), ("rw-p", 0, WRITE), ("rw-p", 8, None), ("r--p", 0, None), ("---p", 0, None)],
)
def test_code_and_unshared_writable_memory_is_loaded(
    rights: str, shared_dirty_kb: int, advice: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(realtime_settings, "_MAPPINGS", tmp_path / "smaps")
    (tmp_path / "smaps").write_text(smaps("1000-3000", rights, shared_dirty_kb))
    assert [*_mappings()] == [(0x1000, 0x2000, advice)] * (advice is not None)


def test_the_stack_behind_the_guard_of_a_thread_is_not_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(realtime_settings, "_MAPPINGS", tmp_path / "smaps")
    parts = [("1000-2000", "---p"), ("2000-4000", "rw-p"), ("5000-6000", "rw-p")]
    (tmp_path / "smaps").write_text("".join(smaps(*part) for part in parts))
    assert [*_mappings()] == [(0x5000, 0x1000, WRITE)]


def smaps(addresses: str, rights: str, shared_dirty_kb: int = 0) -> str:
    """A mapping as /proc/self/smaps has it."""
    return (
        f"{addresses} {rights} 00000000 00:00 0\n"
        f"Size: 8 kB\nShared_Clean: 4 kB\nShared_Dirty: {shared_dirty_kb:10} kB\nVmFlags: rd mr\n"
    )
