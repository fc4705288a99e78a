"""A thread that reads an emulator's statistics at intervals and passes them to a consumer."""

import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Self

from netem.control.command_queue import CommandQueue, Snapshot
from netem.control.emulator_statistics import Statistics, statistics
from noack.core.errors import PeerError

_JOIN_S = 10.0


class StatisticsThread:
    """Calls ``show`` with new statistics at once and then every ``period_s``, within the context.

    It calls ``poll`` every ``poll_s``. With ``at_end``, it shows the final statistics at the end of
    the context; the relay must have ended by then.
    """

    def __init__(
        self,
        commands: CommandQueue,
        period_s: float,
        show: Callable[[Statistics], None],
        *,
        poll: Callable[[], None] = lambda: None,
        poll_s: float = 0.02,
        at_end: bool = False,
    ) -> None:
        self._commands = commands
        self._period_s = period_s
        self._show = show
        self._poll = poll
        self._poll_s = poll_s
        self._at_end = at_end
        self._snapshots: deque[Snapshot] = deque(maxlen=2)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="statistics", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self._thread.join(_JOIN_S)

    def now(self) -> Statistics:
        """Return the present statistics, with rates over the last one or two periods.

        Raises:
            PeerError: the relay has ended, or does not answer.
        """
        before = self._snapshots[0] if self._snapshots else None
        return statistics(self._commands.snapshot(), before)

    def _run(self) -> None:
        due_s = time.monotonic()
        while not self._stopping.wait(min(self._poll_s, max(due_s - time.monotonic(), 0))):
            self._poll()
            if time.monotonic() >= due_s:
                due_s = max(due_s + self._period_s, time.monotonic())
                with suppress(PeerError):
                    self._show_next(self._commands.snapshot())
        if self._at_end:
            self._show_next(self._commands.look())

    def _show_next(self, snapshot: Snapshot) -> None:
        before = self._snapshots[-1] if self._snapshots else None
        self._snapshots.append(snapshot)
        self._show(statistics(snapshot, before))
