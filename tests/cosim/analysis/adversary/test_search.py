"""The search in continuous time against all patterns tried one by one, and the command."""

import json
import math
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from cosim.analysis.adversary import WorstRun
from cosim.analysis.adversary.loop_flows import Objective, evaluate, measure_of
from cosim.analysis.adversary.pattern_search import PatternSearch, search_tree
from cosim.analysis.adversary.scenario_search import find_worst as find_any
from noack.core.errors import ExitStatus
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate
from noack.theory.certificates.conditions import ideal_conditions
from noack.theory.certificates.scenario_certificates import certify
from tests.cosim.analysis.adversary.scenarios import every_run, flow_of, scenarios, simulate
from tests.helpers.command_line import invoke

MANY = settings(suppress_health_check=list(HealthCheck), phases=[Phase.generate])

find_worst = partial(find_any, continuous=True)


def signed(worst: WorstRun) -> float:
    if worst.value is None:
        return -math.inf
    return -worst.value if worst.objective is Objective.INTER_EVENT else worst.value


def rate_of(resolved: Scenario) -> float | None:
    constants = certify(resolved, ideal_conditions(resolved)).constants
    return None if constants is None else constants.rate_per_s


@given(resolved=scenarios(5, mansd=2, window=(2, 5), recovery=2))
@settings(MANY, max_examples=4)
def test_the_search_finds_the_worst_of_all_patterns(resolved: Scenario) -> None:
    """Also without initial patterns, so that only the tree's own branches can find it."""
    runs = list(every_run(resolved))
    for objective in Objective:
        flow = flow_of(resolved, objective, rate_of(resolved))
        expected = max(evaluate(run, flow.measure).value for run in runs)
        worst = find_worst(resolved, objective, beam=0)
        assert worst.exact
        assert signed(worst) == pytest.approx(expected, rel=1e-9)
        assert objective is Objective.COST or not worst.breaches, worst
        tree = PatternSearch(flow, resolved.network.guarantee)
        assert search_tree(tree, 10**6)
        assert tree.value == pytest.approx(expected, rel=1e-6)


@given(
    resolved=scenarios(20),
    objective=st.sampled_from(Objective),
    most_nodes=st.sampled_from([0, 2000]),
)
@settings(max_examples=4)
def test_the_pattern_is_admissible_and_has_the_reported_value(
    resolved: Scenario, objective: Objective, most_nodes: int
) -> None:
    worst = find_worst(resolved, objective, most_nodes=most_nodes, beam=16)
    run = simulate(resolved, worst.pattern)
    assert tuple(run.delivered.tolist()) == worst.pattern, "the cap would have forced a delivery"
    assert run.event_s.tolist() == list(worst.event_s)
    measure = flow_of(resolved, objective, rate_of(resolved)).measure
    assert evaluate(run, measure).value == signed(worst)
    for milder in (worst.lossless, worst.with_own_network):
        best = signed(replace(worst, value=milder))
        assert best <= signed(worst) or best == pytest.approx(signed(worst), rel=1e-9)


def test_a_certificate_that_forgets_a_dropout_is_refuted() -> None:
    """M = 2: for no dropout, Δ would be 1, and almost any loss refutes that."""
    refuted = []

    @given(resolved=scenarios(16, mansd=1, window=(1, 1), n=2, alpha_share=0.2))
    @settings(MANY, max_examples=4)
    def attempt(resolved: Scenario) -> None:
        broken = certify(resolved, ideal_conditions(resolved)._replace(dropouts=0))
        worst = find_worst(resolved, Objective.ERROR, certificate=broken, most_nodes=2000, beam=0)
        refuted.append(worst.breaches)

    attempt()
    assert sum(refuted) >= 0.75 * len(refuted)


def test_a_diverging_loop_has_an_infinite_objective(content: dict[str, Any]) -> None:
    content |= {"model": {"A": [[3.0]], "B": [[1.0]], "gain": [[1.0]]}, "horizon_s": 80.0}
    content["model"]["allow_unstable"] = True
    content["plant"] = {"initial_state": [1.0]}
    worst = find_worst(resolve(validate(content, "small")), Objective.STATE)
    assert worst.diverges
    assert worst.exact
    assert worst.to_json()["value"] is None


# --- objectives against quadrature and dense samples ----------------------------------------------


POINTS = 4001


@given(resolved=scenarios(12))
@settings(max_examples=8)
def test_a_supremum_is_just_above_all_samples(resolved: Scenario) -> None:
    """Between samples, a norm exceeds them by at most the squared spacing times its curvature."""
    run = simulate(resolved, (False,) * 20)
    t_s = np.linspace(0.0, run.horizon_s, POINTS)
    just_before_s = np.nextafter(run.event_s[run.event_s > 0], 0)
    t_s = np.sort(np.concatenate([t_s, just_before_s]))
    samples = run.at(t_s)
    for objective, norms in (
        (Objective.ERROR, run.e_c_norm(samples) / run.system.decaying.level),
        (Objective.STATE, np.linalg.norm(samples.x, axis=1)),
    ):
        measure = measure_of(run.system, objective)
        valued, scaled = evaluate(run, measure), norms / measure.level(t_s)
        assert valued.value >= scaled.max() * (1 - 1e-9)
        assert valued.value == pytest.approx(scaled.max(), rel=1e-3)
        assert valued.at_s is not None
        assert scaled[np.abs(t_s - valued.at_s).argmin()] == pytest.approx(scaled.max(), rel=1e-2)


@given(resolved=scenarios(8))
@settings(max_examples=5)
def test_cost_and_inter_event_time_are_those_of_the_run(resolved: Scenario) -> None:
    run = simulate(resolved, (True, False) * 10)

    def square(t_s: float) -> float:
        return float(np.sum(run.at(np.array([t_s])).x ** 2))

    stops = [0.0, *run.event_s[run.event_s > 0].tolist(), run.horizon_s]
    expected = sum(quad(square, a, b, epsabs=1e-13, epsrel=1e-12)[0] for a, b in pairwise(stops))
    valued = evaluate(run, measure_of(run.system, Objective.COST))
    assert valued.value == pytest.approx(expected, rel=1e-10)
    valued = evaluate(run, measure_of(run.system, Objective.INTER_EVENT))
    between_s = [b - a for a, b in pairwise(run.event_s)]
    assert -valued.value == min(between_s, default=math.inf)
    assert (valued.at_s is None) == (not between_s)


# --- noack adversary ------------------------------------------------------------------------------


SCENARIO = Path(__file__).parents[4] / "scenarios" / "lane_following.toml"


def run(*arguments: str) -> tuple[int, str, str]:
    result = invoke("adversary", SCENARIO, "--horizon", "6", *arguments)
    return result.exit_code, result.stdout, result.stderr


def test_a_policy_is_searched_in_the_sampled_loop() -> None:
    """Without losses x_c differs from x by more than δ only where a test comes too late."""
    trigger = 'trigger={policy="absolute", delta=0.1}'
    arguments = ("--objective", "error", "--set", trigger, "--set", "network.mansd=0")
    status, stdout, _ = run(*arguments, "--json")
    document = json.loads(stdout)
    worst = document["worst"]["error"]
    assert status == ExitStatus.OK
    assert (document["policy"], document["trigger"]) == ("absolute", "sampled")
    assert document["certificate"]["conditions"]["sampling_s"] == 0.002
    assert worst["exact"]
    assert worst["runs"] == 1
    assert 0.1 < worst["value"] < 0.105
    assert "‖e_c‖, scaled" in run(*arguments)[1]


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("start", ["[0.0, 0.0]", "[1e-3, 0.0]"])
def test_a_bound_of_zero_is_searched(start: str) -> None:
    """Plant and model agree and nothing disturbs them: e_c is 0 after the first update."""
    settings = [
        "plant.draw=nominal", "plant.uncertainty_A=", "plant.uncertainty_B=",
        'trigger={policy="periodic", period_s=0.1}', f"plant.initial_state={start}",
    ]  # fmt: skip
    words = [word for setting in settings if not setting.endswith("=") for word in ("--set", setting)]
    arguments = ["adversary", "double_integrator", "--horizon", "0.5", "--nodes", "100"]
    result = invoke(*arguments, *words, "--json")
    assert result.exit_code == ExitStatus.OK, result.output
    for worst in json.loads(result.stdout)["worst"].values():
        assert worst["tightness"] is None or worst["tightness"] <= 1 + 1e-9
