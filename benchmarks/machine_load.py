"""The machine's load by other programs during a benchmark, which makes figures doubtful."""

import ctypes
import resource
from collections.abc import Iterator
from contextlib import suppress

import numpy as np
import psutil

from benchmarks.report import Row

BUSY_SHARE, STEAL_SHARE = 0.1, 0.01
"""Figures are doubtful if other programs, or the hypervisor, used this share of all cores."""


class MachineLoad:
    """The machine's load by other programs since the object's construction.

    This process then adopts orphans of its children.
    """

    def __init__(self) -> None:
        # Nobody waits for the processes of a browser that has ended; here they remain countable.
        ctypes.CDLL(None).prctl(36, 1, 0, 0, 0)  # PR_SET_CHILD_SUBREAPER
        self._before = self._read()

    def rows(self) -> Iterator[Row]:
        """Yield the shares of all cores used by other programs and by the hypervisor."""
        total_s, *used_s = np.subtract(self._read(), self._before).tolist()
        for name, seconds, doubtful in zip(
            ("other programs", "steal"), used_s, (BUSY_SHARE, STEAL_SHARE), strict=True
        ):
            share = max(seconds, 0.0) / max(total_s, 1e-9)
            doubt = "the machine was busy: figures are doubtful" if share > doubtful else None
            yield Row(f"machine: {name}", 100 * share, "% of all cores", note=doubt)

    @staticmethod
    def _read() -> tuple[float, float, float]:
        """CPU seconds: of all cores, used by other programs, taken by the hypervisor."""
        times = psutil.cpu_times()
        total_s = sum(times) - times.guest - times.guest_nice  # included in the users' time
        others_s = total_s - times.steal - times.idle - times.iowait
        others_s -= own_cpu_s() + own_cpu_s(children=True)
        for process in psutil.Process().children(recursive=True):  # not waited for
            with suppress(psutil.NoSuchProcess):
                others_s -= sum(process.cpu_times()[:4])  # its own, and of those it waited for
        return total_s, others_s, times.steal


def own_cpu_s(*, children: bool = False) -> float:
    """Return the CPU time of this process, or of its children that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN if children else resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime
