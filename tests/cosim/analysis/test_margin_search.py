"""The margin of a scenario: the search, the command, the library."""

import json
import signal
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import noack
from cosim.analysis.margin_search import find_longest_period, find_margin
from cosim.cli.options import load_scenario
from noack.core.linear_systems import discretise
from noack.scenario.resolution import loop_of, resolve
from noack.scenario.scenario import Scenario
from noack.theory.witnesses.loss_margin import LossMargin, Stability
from tests.helpers.command_line import invoke

HELD = {
    "mode": "zoh",
    "trigger": {"policy": "periodic", "period_s": 0.1},
    "plant.rate_hz": 50.0,
    "controller.rate_hz": 50.0,
    "network.mansd": 0,
}


DEADLINE = [
    "--set", 'trigger={policy="deadline", interval_s=0.8, rule={policy="absolute", delta=1}}',
    "--set", "plant.rate_hz=5", "--set", "controller.rate_hz=5", "--set", "mode=zoh",
]  # fmt: skip


def held_integrator(**settings: object) -> Scenario:
    """The double integrator, x held between updates every 0.1 s."""
    return noack.with_settings(noack.load("double_integrator"), {**HELD, **settings})


def test_longest_period_is_that_of_the_sampled_loop() -> None:
    """Without losses, the map over a period is known in closed form."""
    resolved = resolve(held_integrator())
    loop, h = loop_of(resolved), 20_000_000

    def radius(steps: int) -> float:
        # The first step of each period still has the older input.
        (A1, B1), (A, B) = (discretise(loop.A, loop.B, h * k) for k in (1, steps - 1))
        held = np.block([[A @ A1 + B @ loop.K, A @ B1], [loop.K, np.zeros((1, 1))]])
        return float(np.abs(np.linalg.eigvals(held)).max())

    limit = find_longest_period(resolved)
    assert limit.stable_s is not None
    assert limit.unstable_s == pytest.approx(limit.stable_s + 0.02)
    assert radius(round(limit.stable_s * 50)) < 1 < radius(round(limit.unstable_s * 50))
    assert limit.stability is not None
    assert limit.stability.lower == pytest.approx(radius(round(limit.unstable_s * 50)), rel=1e-9)


def test_verdicts_agree_with_the_bounds() -> None:
    trigger = {"policy": "periodic", "period_s": 0.5}
    margin = find_margin(resolve(held_integrator(trigger=trigger)), with_period=False)
    assert [cap.mansd for cap in margin.caps] == list(range(len(margin.caps)))
    assert [cap.stability.verdict for cap in margin.caps[:-1]] == ["stable"] * (len(margin.caps) - 1)
    assert all(cap.stability.upper < 1 for cap in margin.caps[:-1])
    growth = [cap.stability.lower for cap in margin.caps]
    assert growth == sorted(growth)
    assert margin.destabilised is not None
    assert margin.destabilised.stability.lower > 1
    text = f"at most {margin.stable_mansd} lost in a row; with {len(growth) - 1} lost in a row this pattern"
    assert f"{text} destabilises: D" in str(margin)


def test_constraints_that_limit_the_losses_alone_make_every_mansd_stable() -> None:
    constraints = [{"kind": "at_most", "losses": 1, "window": 4}]
    settings = {"network.constraints": constraints, "network.mansd": 5}
    margin = noack.margin(held_integrator(**settings), period=False)
    assert margin.every_mansd
    assert margin.stable_mansd == 1
    assert "with any mansd ≥ 1" in margin.verdict
    assert margin.to_json()["period"] is None
    assert margin.unverified_text == ""
    unverified = replace(margin, proof=None)
    text = (
        "that the loop is stable with at most 1 lost in a row: computed by noack with error bounds, "
        "not verified by noack-check"
    )
    assert unverified.unverified_text == text
    assert text in repr(unverified)
    assert margin.verdict.startswith("proven stable for every loss pattern")
    assert unverified.verdict.startswith("stable for every loss pattern")
    with pytest.raises(noack.NoackError, match="most -1: expected at least 0"):
        noack.margin("lane_periodic", most_mansd=-1)


@pytest.mark.deep
def test_a_loop_with_events_has_a_margin_for_all_times_between_them() -> None:
    result = invoke("margin", "double_integrator", *DEADLINE, "--json")
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    assert (document["shortest_s"], document["period_s"]) == (0.2, 0.8)
    last = document["caps"][-1]
    assert last["verdict"] == "destabilised"
    assert len(last["intervals_s"]) == len(last["pattern"].replace("L", "D").split("D")) - 1
    result = invoke("margin", "double_integrator", *DEADLINE, "--no-period")
    assert "with updates 0.2 to 0.8 s apart" in " ".join(result.output.split())
    words = ["margin", "lane_periodic", "--no-period", "--most", "1"]
    assert "proven stable for every loss pattern with at most 1 lost in a row" in invoke(*words).output


def test_the_played_settings_are_the_pattern() -> None:
    cap = noack.margin("lane_periodic", period=False).destabilised
    assert cap is not None
    played = load_scenario("lane_periodic", cap.settings)
    assert played.network.mansd == cap.mansd
    run = noack.simulate(played)
    received = run.events()["received"].to_pylist()
    pattern = cap.stability.pattern
    expected = [pattern[i % len(pattern)] for i in range(len(received))]
    assert received[:-1] == expected[:-1]


def test_stronger_and_weaker_guarantees_are_compared_with_the_scenarios() -> None:
    words = ["atmost 6 in 7", "mansd 4 recover 2"]
    margin = noack.margin("lane_periodic", most_mansd=0, period=False, guarantees=words)
    own, weaker, stronger = margin.compared.guarantees
    assert (own.stability.verdict, stronger.stability.verdict) == ("stable", "stable")
    assert weaker.stability.verdict == "destabilised"
    assert stronger.stability.upper <= own.stability.upper <= weaker.stability.upper
    first, second, third = margin.compared.relations
    cap, window = "at most 4 lost in a row", "at most 6 losses in 7"
    assert first.startswith(f"“{cap}” implies “{window}")
    assert first.endswith("which also allows LLLLL")
    assert second.endswith(f"implies “{cap}”, which also allows LDL")
    assert f"implies “{window}" in third
    assert [compared["verdict"] for compared in margin.to_json()["compared"]] == [
        "stable", "destabilised", "stable"
    ]  # fmt: skip
    options = ["--no-period", "--most", "0", "--guarantee", "atmost 6 in 7"]
    printed = " ".join(invoke("margin", "lane_periodic", *options).output.split())
    assert first in printed


@pytest.mark.usefixtures("usual_signals")
@pytest.mark.parametrize("json_output", [False, True])
def test_ctrl_c_leaves_what_was_decided(monkeypatch: pytest.MonkeyPatch, json_output: bool) -> None:
    decide, decided = LossMargin.stability, 0

    def interrupted(self: LossMargin, *arguments: Any, **more: Any) -> Stability:
        nonlocal decided
        decided += 1
        if decided == 3:
            signal.raise_signal(signal.SIGINT)
        return decide(self, *arguments, **more)

    monkeypatch.setattr(LossMargin, "stability", interrupted)
    result = invoke("margin", "lane_periodic", *(["--json"] if json_output else []))
    missing = ["2 and more losses in a row", "the longest period", "random losses", "the certificate"]
    line = f"noack: stopped by the user (SIGINT); missing: {', '.join(missing)}"
    assert (result.exit_code, result.stderr.splitlines()[-1]) == (130, line)
    if json_output:
        document = json.loads(result.stdout)
        assert [cap["mansd"] for cap in document["caps"]] == [0, 1]
        assert document["stable_mansd"] == 1
        assert document["missing"] == missing
        assert document["period"] is None
    else:
        assert (
            "\nstable for every loss pattern with at most 1 lost in a row" in result.stdout
        )  # noack-check was not asked yet


def test_no_longest_time_between_updates_is_below_the_least_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """There the loop is examined with equal times only, not with all up to the longest one."""
    unstable = Stability(1.1, 1.2, (True,), (0.2,), 0)
    monkeypatch.setattr(LossMargin, "coarse_bounds", lambda _: unstable)
    rule = {"policy": "dwell", "interval_s": 0.2, "rule": {"policy": "absolute", "delta": 0.1}}
    trigger = {"policy": "deadline", "interval_s": 0.8, "rule": rule}
    scenario = noack.load("double_integrator", {"trigger": trigger, "plant.measure_every": 10})
    limit = find_longest_period(resolve(scenario))
    assert limit.is_longest
    assert limit.stable_s is None
    assert limit.unstable_s == pytest.approx(0.2)
