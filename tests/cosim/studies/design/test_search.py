"""The chosen design meets the limits, and no cheaper candidate does."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cosim.simulation.exact_simulation import run_batch, setting_of
from cosim.studies.campaign.random_draws import box_of
from cosim.studies.design.design_search import (
    DesignLimits,
    DesignResult,
    measure,
    require_draws,
)
from cosim.studies.design.design_space import LEVELS
from noack.core.errors import CallerError
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import dumps, load
from noack.theory.certificates.conditions import ideal_conditions
from noack.theory.certificates.scenario_certificates import certify_box
from tests.cosim.studies.design.conftest import LIMITS, designed


def test_the_chosen_design_settles_in_time_on_draws_of_another_seed(found: DesignResult) -> None:
    assert found.feasible
    assert found.confirmed
    setting = replace(setting_of(resolve(found.scenario)), settle=LIMITS.settle)
    rows = run_batch(setting, box_of(found.scenario).population(99, range(2000)))
    share = float(np.mean(rows["settling_s"] <= LIMITS.settling_s))
    assert share >= LIMITS.quantile
    # 4 standard deviations of the difference of two means
    spread = 4 * np.hypot(found.fresh.halfwidth, 0.12) / 1.96
    assert abs(rows["transmissions"].mean() - found.fresh.transmissions) < spread


def test_the_chosen_design_is_certified_as_required(found: DesignResult, tmp_path: Path) -> None:
    path = tmp_path / "chosen.toml"
    path.write_text(dumps(found.scenario))
    resolved = resolve(load(path))
    certificate = certify_box(resolved, ideal_conditions(resolved))
    assert certificate is not None
    assert certificate.constants is not None
    weight = resolved.decaying.weight
    smallest = 1.0 if weight is None else np.linalg.svd(np.array(weight), compute_uv=False)[-1]
    bound = certificate.constants.delta * resolved.decaying.beta / smallest
    assert bound <= LIMITS.bounds["error"]
    # The bound is the active limit: without it a cheaper design exists.
    assert found.bounds is not None
    assert found.bounds["error"] == pytest.approx(bound)


def test_no_candidate_meets_the_limits_with_fewer_transmissions(found: DesignResult) -> None:
    best = found.best.measured
    assert found.best.full
    assert best.settling_high_s <= LIMITS.settling_s
    cheaper = [t for t in found.trials if t.measured.transmissions < best.transmissions]
    assert len(cheaper) > 10
    for trial in cheaper:
        m = trial.measured
        late = (m.settling_high_s if trial.full else m.settling_s) > LIMITS.settling_s
        assert late or trial.bounds["error"] > LIMITS.bounds["error"], trial


def test_screening_excludes_no_design_that_all_draws_would_choose(found: DesignResult) -> None:
    """Every grid candidate that was only screened out is measured on all draws here."""
    best = found.best.measured
    population = box_of(found.scenario).population(found.seed, range(best.draws))
    rescued = 0
    for trial in found.trials:
        if trial.full or trial.measured.transmissions > best.transmissions:
            continue
        scenario = found.space.families[trial.candidate.family].with_trigger(trial.candidate)
        rescued += measure(scenario, LIMITS, population).settling_high_s <= LIMITS.settling_s
    assert rescued == 0


def test_the_trade_off_curve_contains_the_nondominated_candidates(found: DesignResult) -> None:
    assert len(found.front) > 3
    points = [(t.measured.transmissions, t.measured.settling_s) for t in found.front]
    assert points == sorted(points)
    assert sorted((s for _, s in points), reverse=True) == [s for _, s in points]
    for trial in found.front:
        assert trial.full
        assert trial.bounds["error"] <= LIMITS.bounds["error"]
    for trial in found.trials:
        if trial.bounds.get("error", 0.0) <= LIMITS.bounds["error"]:
            sent, settling_s = trial.measured.transmissions, trial.measured.settling_s
            assert not any(sent < a and settling_s < b for a, b in points)
            better = any(a <= sent and b <= settling_s for a, b in points)
            assert better or trial in found.front or settling_s == math.inf


def test_the_same_seed_gives_the_same_design_and_another_seed_other_draws(
    scenario: Scenario,
) -> None:
    limits = replace(LIMITS, bounds={})
    one, again, other = (designed(scenario, limits, draws=40, seed=s) for s in (5, 5, 6))
    assert again.document() == one.document()
    assert other.fresh != one.fresh


def test_candidates_lie_below_the_decay_rate(found: DesignResult) -> None:
    # s² + 1.5 s + 1: the real part of both roots is −0.75
    assert 0.7 < max(trial.candidate.alpha_per_s for trial in found.trials) < 0.75
    assert min(trial.candidate.beta for trial in found.trials) > LEVELS[0] / 3


def test_infeasible_limits_are_reported_with_the_closest_candidate(scenario: Scenario) -> None:
    found = designed(scenario, DesignLimits(1.0, 0.5, 0.02, {}), draws=20)
    assert not found.feasible
    assert not found.confirmed
    assert f"{found.best.measured.settling_s:.4g} s" in found.verdict()
    closest = found.best.measured.settling_high_s
    assert all(t.measured.settling_high_s >= closest for t in found.trials if t.full)


def test_no_bound_is_certified_for_a_drawn_initial_state(scenario: Scenario) -> None:
    plant = scenario.plant.model_copy(update={"initial_state_halfwidth": (0.1, 0.1)})
    with pytest.raises(CallerError, match="initial_state_halfwidth"):
        designed(scenario.model_copy(update={"plant": plant}), LIMITS)


def test_too_few_draws_for_a_quantile_are_refused_with_the_required_number() -> None:
    with pytest.raises(CallerError, match="--draws: 50 are too few") as caught:
        require_draws(50, 0.95)
    enough = int(str(caught.value).split()[-3])
    require_draws(enough, 0.95)
    assert 1 - 0.95**enough >= 0.975  # P(the largest value exceeds the quantile)


def test_the_largest_excess_over_a_limit_counts() -> None:
    limits = DesignLimits(10.0, 0.95, 0.02, {"state": 4.0, "error": 1.0})
    assert limits.excess(10.0, {"state": 4.0, "error": 1.0}) == 0
    assert limits.excess(20.0, {"state": 5.0, "error": 1.0}) == pytest.approx(0.5)
    assert limits.excess(9.0, {"state": math.inf, "error": 1.0}) == 1
    assert limits.excess(9.0, {}) == 0  # not yet computed
