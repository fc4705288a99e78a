"""Each short run that a test here simulates is compared with the model of its scenario."""

import pytest

from cosim.record.run_record import RecordedRun
from cosim.simulation import virtual_time
from noack.core.progress import Progress
from noack.scenario.resolution import ResolvedRun
from tests.oracles.explained_run.explain import explains

MOST_STEPS = 1500
"""Of the plant, in a run that is compared."""


@pytest.fixture(autouse=True)
def short_runs_are_those_of_the_model(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compare runs on the scenario's own network, in which nothing is late."""
    simulate = virtual_time._simulate

    def explained(run: ResolvedRun, network: object, progress: Progress) -> RecordedRun:
        recorded = simulate(run, network, progress)  # type: ignore[arg-type]
        for number, loop in enumerate(run.loops if network is None else ()):
            if loop.horizon_s * loop.plant.rate_hz <= MOST_STEPS:
                findings = explains(recorded.record(number))
                assert not findings, "\n".join([loop.name, *map(str, findings[:5])])
        return recorded

    monkeypatch.setattr(virtual_time, "_simulate", explained)
