"""How many loops a link carries: against R h / bits, with its limits, figures and mistakes."""

import json
import math
import re
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from click.testing import Result

from cosim.studies.campaign.campaign_grid import grid
from cosim.studies.campaign.campaign_summary import summarise
from cosim.studies.campaign.campaign_workers import run_in_process
from cosim.studies.campaign.chunk_store import Store, run_campaign
from cosim.studies.campaign.drawn_runs import used_up
from cosim.studies.campaign.metrics import METRICS, estimate
from cosim.studies.capacity import capacity_plan as plans
from cosim.studies.capacity.capacity_page import CapacityResult, comparison_sentences, mixture_sentences
from cosim.studies.capacity.capacity_plan import kinds_of, policies_of
from cosim.studies.capacity.capacity_result import (
    Capacity,
    PolicyCapacity,
    capacities,
    capacity_of,
    prediction_interval,
)
from noack.protocol.record_tables import Fate
from noack.scenario.scenario_file import load
from tests.helpers.command_line import invoke

FILE = Path(__file__).parents[4] / "scenarios" / "shared_bottleneck.toml"
PERIOD_S = 0.1
BITS = 8 * (28 + 64)
"""Bits of an update of two states on the link: UDP and IPv4, and the datagram of docs/wire.md."""
SHORT = ("--set", "horizon_s=1.0", "--set", "plant.rate_hz=50", "--set", "controller.rate_hz=50")
LOOP = "loops=[{ name = 'loop' }]"


def study(tmp_path: Path, queue: int, deadline_s: float = PERIOD_S) -> CapacityResult:
    """Periodic loops on a link that carries the updates of exactly six."""
    rate_bps = round(6 / PERIOD_S * BITS)
    stage = f"network.impairments=[{{ kind = 'rate', rate_bps = {rate_bps}, queue = {queue} }}]"
    scenario = load(FILE, [stage, "network.loss.probability=0.0", "horizon_s=3.0", LOOP])
    settings = {
        "horizon_s": 3.0,
        "network.impairments": [{"kind": "rate", "rate_bps": rate_bps, "queue": queue}],
        "network.loss.probability": 0.0,
        "certificate.network_delay_s": deadline_s,
    }
    kinds = kinds_of(scenario, PERIOD_S)
    plan = plans.CapacityPlan(
        scenario, kinds, FILE, settings, deadline_s, (1, 6, 7),
        {"periodic": policies_of(kinds)["periodic"]}, 0.0, 2, 5,
    )  # fmt: skip
    campaign = plan.campaign()
    store = Store(tmp_path, grid(campaign, Path("study")), plan.draws, 1)
    run_campaign(store, run_in_process)
    summary = summarise(campaign, store)
    return CapacityResult(plan, summary, capacities(plan, summary, store), [])


def limits_of(result: CapacityResult) -> tuple[PolicyCapacity, dict[str, float]]:
    (policy_capacity,) = result.capacities
    return policy_capacity, {name: limit.median for name, limit in policy_capacity.limits.items()}


def test_a_queue_carries_as_many_periodic_loops_as_the_rate_allows(tmp_path: Path) -> None:
    policy_capacity, limits = limits_of(study(tmp_path / "long", queue=100))  # it delays, and drops nothing
    assert policy_capacity.any_limit.median == limits["deadline"] == 6
    assert limits["guarantee"] == np.inf
    result = study(tmp_path / "short", queue=6, deadline_s=2 * PERIOD_S)
    assert result.plan.periodic_loops == pytest.approx(6.0, rel=1e-6)
    policy_capacity, limits = limits_of(result)
    # The seventh loop overflows the queue of six, in which updates wait for about a period.
    assert policy_capacity.any_limit.median == limits["guarantee"] == 6
    assert limits["deadline"] == np.inf
    assert policy_capacity.limited_by == "guarantee"


def test_a_policy_must_keep_the_cost_of_each_kind_of_loop() -> None:
    """Kind b costs a hundred times as much as a; a alone doubles its cost in the mixture."""
    kinds = kinds_of(load(FILE, ["loops=[{ name = 'a' }, { name = 'b' }]"]), PERIOD_S)
    plan = plans.CapacityPlan(load(FILE), kinds, FILE, {}, 0.1, (2, 4), policies_of(kinds), 0.0, 3, 0)
    quiet = {"loops_guarantee_used": np.zeros(3), "updates_late": np.zeros(3)}

    def runs(a: float, b: float) -> dict[str, Any]:
        return quiet | {"cost_of_a": np.full(3, a), "cost_of_b": np.full(3, b)}

    own = {"2 unshared": runs(1.0, 100.0), "4 unshared": runs(1.0, 90.0)}
    policy_capacity = capacity_of(plan, "model", "own", {"2": runs(1.9, 110.0), "4": runs(2.1, 110.0)} | own)
    assert (policy_capacity.any_limit.median, policy_capacity.limited_by) == (2, "cost")
    for median, expected in (
        (2.0, "1 × the given mixture (1 a, 1 b)"),
        (np.inf, "at least 2 × the given mixture (2 a, 2 b)"),
        (0.0, "0 × the given mixture; 1 a, 1 b already reach a limit"),
    ):
        carried = policy_capacity._replace(any_limit=Capacity(median, 0.0, np.inf))
        (sentence,) = mixture_sentences(CapacityResult(plan, Mock(), [carried], []))
        assert sentence == f"model, disturbance own: {expected}"


@pytest.mark.parametrize(
    ("ends", "outcome"),
    [
        ((7, 9), "wins"),
        ((np.inf, np.inf), "wins"),
        ((1, 2), "loses"),
        ((6, 9), "undecided"),
        ((2, 3), "undecided"),
    ],
)
def test_a_policy_wins_or_loses_only_if_the_intervals_do_not_overlap(
    ends: tuple[float, float], outcome: str
) -> None:
    kinds = kinds_of(load(FILE, [LOOP]), PERIOD_S)
    plan = plans.CapacityPlan(load(FILE), kinds, FILE, {}, 0.1, (1, 9), policies_of(kinds), 0.0, 6, 0)
    carried = {"periodic": Capacity(4.0, 3.0, 6.0), "model": Capacity(ends[0], *ends)}
    both = [PolicyCapacity(policy, plans.OWN, {}, capacity) for policy, capacity in carried.items()]
    (sentence,) = comparison_sentences(CapacityResult(plan, Mock(), both, []))
    assert sentence.startswith(f"model against periodic, as in the scenario: {outcome}")


def test_95_of_100_further_draws_are_in_the_prediction_interval() -> None:
    """Of normal values; their number is within four standard deviations."""
    draws = np.random.default_rng(4).normal(3.0, 2.0, (4000, 5))
    ends = np.array([prediction_interval(estimate(draw[:4])) for draw in draws])
    inside = (ends[:, 0] <= draws[:, 4]) & (draws[:, 4] <= ends[:, 1])
    assert inside.mean() == pytest.approx(0.95, abs=4 * math.sqrt(0.95 * 0.05 / len(draws)))
    assert prediction_interval(estimate(draws[0, :1])) == (-math.inf, math.inf)


def test_the_guarantee_is_used_up_by_a_burst_with_a_full_queue() -> None:
    letters = {"d": Fate.DELIVERED, "f": Fate.FORCED, "x": Fate.DROPPED, "o": Fate.OVERFLOWED}
    random = np.random.default_rng(3)
    seen = set()
    for _ in range(300):
        text = "".join(random.choice([*letters], 12))
        burst = int(random.integers(1, 5))
        bursts = re.findall("[xo]+", text)
        expected = any(len(letter_burst) >= burst and "o" in letter_burst for letter_burst in bursts)
        assert used_up(np.array([letters[letter] for letter in text]), burst) == expected, (text, burst)
        seen.add(expected)
    assert seen == {True, False}
    assert "full queue" in METRICS["loops_guarantee_used"].title


@pytest.fixture
def no_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands without page and figures, which take longer than small studies."""
    monkeypatch.setattr("cosim.studies.capacity.capacity_page.write", lambda *_: [])


def capacity(*words: str) -> Result:
    return invoke("capacity", *words)


@pytest.mark.usefixtures("no_page")
def test_the_default_answers_for_the_shipped_mixture_and_says_how_long_it_takes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert plans.QUICK.draws == 6
    monkeypatch.setattr(plans, "QUICK", plans.QUICK._replace(draws=2))
    out = "--out", str(tmp_path), "--workers", "1", "--json", "--set", "horizon_s=0.2"
    result = capacity("shared_bottleneck", *out, *SHORT[2:])
    assert result.exit_code == 0, result.output
    assert re.search(
        r"36 runs of 0.2 s with 11 to 33 loops; the simulation takes about \d+ s on an idle core; "
        r"--thorough: \d+ (s|min)\n",
        result.stderr,
    )
    document = json.loads(result.stdout)
    assert (document["loops"], document["draws"], document["thorough"]) == ([11, 22, 33], 2, False)
    for row in document["capacities"]:
        if row["median"] is not None:
            assert row["loops_by_kind"]["pendulum"] == 10 * row["factor"] == row["median"] / 1.1
    again = capacity("shared_bottleneck", *out, *SHORT[2:])
    assert again.exit_code == 0
    assert json.loads(again.stdout)["made"] == 0
    assert "takes about" not in again.stderr


@pytest.mark.usefixtures("without_viewer")
def test_the_command_compares_the_policies_and_confirms_a_point_live(tmp_path: Path) -> None:
    result = capacity(
        str(FILE), "--set", LOOP, "--loops", "2", "--draws", "1", "--disturbance", "1",
        "--workers", "1", "--json", *SHORT,
        "--rate-bps", "60000", "--policy", "slow={ policy = 'periodic', period_s = 0.5 }",
        "--confirm", "model=2", "--out", str(tmp_path),
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    assert {row["policy"] for row in document["capacities"]} == {"periodic", "zoh", "model", "slow"}
    assert {row["disturbance"] for row in document["capacities"]} == {
        "as in the scenario",
        "common",
    }
    assert len(document["comparisons"]) == 6
    (live,) = document["live"]
    assert (live["policy"], live["loops"], live["status"]) == ("model", 2, 0)
    assert live["values"]["transmissions"] > 0
    assert "crosses are live runs" in (tmp_path / "capacity.html").read_text()


@pytest.mark.usefixtures("no_page")
def test_a_schedule_carries_as_many_loops_as_its_delay_allows(tmp_path: Path) -> None:
    """Loops that transmit every 60 ms, or every 20 ms, in turn in slots of 10 ms; M = 4, Q = 1."""
    result = capacity(
        "scheduled_channel", "--loops", "2,5,9", "--update-period", "0.06", "--late-after", "0.05",
        "--set", "network.impairments.0.slot_s=0.01", "--set", "network.loss.probability=0",
        "--workers", "1", "--json", "--out", str(tmp_path), *SHORT,
    )  # fmt: skip
    document = json.loads(result.stdout)
    assert document["periodic_loops_by_rate"] == pytest.approx(6.0)
    inf = None  # of JSON
    assert document["delay_bounds_s"]["periodic"] == pytest.approx([0.01, 0.02, 0.05, 0.18])
    assert document["delay_bounds_s"]["model"] == pytest.approx([0.01, 0.02, 0.1, inf])
    row, *_ = document["capacities"]
    assert (row["policy"], row["median"]) == ("periodic", 5.0)
    assert result.exit_code == 0
