"""The worst losses of plants that are not given by matrices."""

import pytest

from cosim.analysis.adversary import Objective, find_worst, find_worst_by_runs
from cosim.analysis.scenario_certificates import certificate_of, quick_certificate
from noack.theory.certificates.conditions import allowed_conditions
from tests.checker.proofs import ANGLE, proved
from tests.helpers.shipped import resolved

ALL = tuple(Objective)


def test_runs_of_a_linear_plant_have_the_values_of_the_linear_search() -> None:
    scenario = resolved("unstable_pendulum", "horizon_s=2.0")
    certificate = quick_certificate(scenario)
    aims = (Objective.ERROR, Objective.STATE)
    by_runs = find_worst_by_runs(scenario, aims, certificate, most_runs=40).objectives
    for aim, found in zip(aims, by_runs, strict=True):
        searched = find_worst(scenario, aim, most_nodes=2_000, beam=16, certificate=certificate)
        # Errors are those at measurements, where the record has them, there at steps of the plant.
        near = {"rel": 0.02 if aim is Objective.ERROR else 1e-9}
        assert found.lossless == pytest.approx(searched.lossless, **near)
        assert found.with_own_network == pytest.approx(searched.with_own_network, **near)
        assert found.value is not None
        assert found.lossless is not None
        assert found.lossless <= found.value
        assert found.tightness is not None
        assert found.tightness <= 1


def test_a_plant_of_equations_is_searched_by_runs_within_its_guarantee() -> None:
    scenario = resolved("sine_pendulum", "horizon_s=1.5", ANGLE)
    certificate = certificate_of(
        scenario, proved("sine_pendulum_angle").statement, allowed_conditions(scenario)
    )
    assert certificate.proven is not None
    found, shares = find_worst_by_runs(scenario, ALL, certificate, most_runs=24)
    assert [worst.objective for worst in found] == list(ALL)
    for worst in found:
        assert worst.pattern[0]
        assert "L" * (scenario.network.mansd + 1) not in worst.text
        assert not worst.breaches
        assert worst.runs <= 24 + 2 * len(ALL)
    assert (found, shares) == find_worst_by_runs(scenario, ALL, certificate, most_runs=24)
    assert shares.keys() == {"angle"}
    assert 1 / 3 < shares["angle"] <= 1
    (state,) = (worst for worst in found if worst.objective is Objective.STATE)
    assert state.tightness is not None
    assert state.tightness > 1 / 3
