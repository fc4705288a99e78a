"""Runs in virtual time against the reference loop of tests/oracles/whole_loop.py."""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest

from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import simulate
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load, validate
from noack.scenario.sections import POLICIES as POLICY_KINDS
from tests.oracles import whole_loop
from tests.oracles.comparison import Comparison
from tests.oracles.random_scenarios import POLICIES, random_scenario
from tests.oracles.reference_run import settings_of, why_not
from tests.oracles.whole_loop import NONE, Settings

SCENARIOS = sorted((Path(__file__).parents[3] / "scenarios").glob("*.toml"))
RANDOM = 240
"""Random scenarios: 20 of each trigger policy."""


@pytest.mark.parametrize("path", SCENARIOS, ids=lambda path: path.stem)
def test_a_shipped_scenario(path: Path) -> None:
    scenario = load(path)
    if reason := why_not(scenario):
        pytest.skip(reason)
    assert Comparison(simulate(resolve(scenario))).tie_ns is None


def test_every_policy_is_among_the_random_scenarios() -> None:
    assert {*POLICIES} == POLICY_KINDS.keys() - {"python"}


@cache
def random_run(number: int) -> RunRecord:
    return simulate(resolve(validate(random_scenario(number), "random")))


@cache
def compared(number: int) -> Comparison:
    return Comparison(random_run(number))


@pytest.mark.parametrize("policy", POLICIES)
def test_random_scenarios(policy: str) -> None:
    first = POLICIES.index(policy)
    found = [compared(number) for number in range(first, RANDOM, len(POLICIES))]
    assert sum(one.tie_ns is not None for one in found) <= 1
    assert sum((one.rows["sensor_measurement"]["event"] != NONE).sum() for one in found) > 100


def test_the_random_scenarios_have_every_feature() -> None:
    counts: Counter[str] = Counter()
    for number in range(RANDOM):
        scenario, one = random_run(number).scenario, compared(number)
        steps, measured = one.found["plant_step"], one.found["sensor_measurement"]
        delivered, packets = one.found["controller_delivery"], one.rows["netem_packet"]
        has = {
            scenario.mode: True,
            scenario.network.initial_sync: True,
            f"observer {scenario.observer and scenario.observer.kind}": True,
            f"watchdog {scenario.plant.watchdog.policy}": any(r["entry"] == NONE for r in steps),
            "prediction": any(row["entry"] > 0 for row in steps),
            "set point": any(scenario.controller.setpoint or ()),
            "changes": bool(scenario.changes),
            "acknowledgements": bool(one.found["sensor_acknowledgement"]),
            "updates lost": any(row["dropouts"] > 0 for row in delivered),
            "updates late": any(row["model_t_ns"] > row["t_ns"] for row in delivered),
            "update of the time of a step": any(
                row["model_t_ns"] % scenario.timing.plant_period_ns == 0 for row in delivered
            ),
            "event by comparison": any(r["event"] > 0 and r["is_compared"] for r in measured),
            "event by time": any(row["t_ns"] >= row["due_ns"] for row in measured),
            "actuations or acknowledgements lost": 1 in packets["flow"][packets["release_ns"] < 0],
        }
        counts.update(feature for feature, found in has.items() if found)
    assert len(counts) == 20, counts
    assert min(counts.values()) >= 10, counts


DAMAGE: dict[str, Callable[[Settings], Settings]] = {
    "plant": lambda s: replace(s, B=s.B * (1 + 1e-6)),
    "model": lambda s: replace(s, H=s.H * (1 + 1e-6)),
    "gain": lambda s: replace(s, K=s.K * (1 + 1e-6)),
    "initial state": lambda s: replace(s, x0=s.x0 + 1e-6),
    "safe input": lambda s: replace(s, safe_input=s.safe_input + 1e-6),
    "changed rule": lambda s: replace(s, rules=s.rules[:1]),
    "changed set point": lambda s: replace(s, setpoints=s.setpoints[:1]),
    "later change": lambda s: replace(s, setpoints=[(t and t + 1000, x) for t, x in s.setpoints]),
    "watchdog": lambda s: replace(s, watchdog="zero" if s.watchdog == "hold" else "hold"),
    "timeout": lambda s: replace(s, watchdog_timeout_ns=s.watchdog_timeout_ns - s.plant_period_ns),
    "acknowledgements": lambda s: replace(
        s, acknowledgement_timeout_ns=s.acknowledgement_timeout_ns and 10**7
    ),
    "observer": lambda s: replace(
        s, observer=s.observer and {key: one * (1 + 1e-5) for key, one in s.observer.items()}
    ),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_wrong_setting_is_found(damage: str) -> None:
    require_a_difference(DAMAGE[damage])


def require_a_difference(damage: Callable[[Settings], Settings]) -> None:
    """Require that a reference with other settings differs from one of the random runs."""
    for number in range(RANDOM):
        record = random_run(number)
        try:
            Comparison(record, damage(settings_of(record.scenario)))
        except AssertionError:
            return
    pytest.fail("the comparison does not see it")


@pytest.mark.parametrize(
    ("of", "rank"),
    [("TICK", 2.5), ("TICK", -1), ("PLANT", 3.5), ("FORWARD", 3.5), ("REVERSE", -1)],
)
def test_another_order_at_the_same_time_is_found(
    of: str, rank: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """E.g. ticks before datagrams, which have the rank 3."""
    monkeypatch.setattr(whole_loop, of, rank)
    require_a_difference(lambda settings: settings)


def test_a_tie_ends_the_comparison_of_a_run_and_is_no_difference() -> None:
    """δ becomes the ‖e_s‖ of an event, so that the comparison there is decided by rounding."""
    ties = 0
    for number in range(POLICIES.index("absolute"), RANDOM, len(POLICIES)):
        content = random_scenario(number)
        content.pop("changes", None)
        measured = simulate(resolve(validate(content, "random")))["sensor_measurement"]
        later = measured[measured["event"] > 0]
        if not len(later):
            continue
        content["trigger"]["delta"] = float(later["compared"][0])
        ties += Comparison(simulate(resolve(validate(content, "random")))).tie_ns is not None
    assert ties > 0
