"""Seconds of a run in which the hypervisor took CPU time are found, with those around them."""

from types import SimpleNamespace

import psutil
import pytest

from benchmarks import _stolen_time
from benchmarks._stolen_time import StolenTime

CORES = 2


@pytest.mark.parametrize(
    ("taken", "quiet"), [({}, range(30)), ({14: 0.5}, [*range(10), *range(16, 30)])]
)
def test_a_second_is_quiet_if_nothing_was_taken_in_it_and_around_it(
    taken: dict[int, float], quiet: range | list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half a core second is taken between the samples at 12 and 14 s of the run."""
    stolen, counted_s = StolenTime(), 0.0
    monkeypatch.setattr(psutil, "cpu_count", lambda: CORES)
    for since_s in range(-4, 40, 2):
        counted_s += taken.get(since_s, 0.0)
        times = SimpleNamespace(steal=counted_s)
        monkeypatch.setattr(psutil, "cpu_times", lambda times=times: times)
        monkeypatch.setattr(_stolen_time.time, "time", lambda now_s=1000 + since_s: now_s)
        stolen.sample()
    assert stolen.quiet_seconds(1000.0, 30.0).tolist() == list(quiet)


def test_without_samples_no_second_is_quiet() -> None:
    assert StolenTime().quiet_seconds(0.0, 10.0).size == 0
