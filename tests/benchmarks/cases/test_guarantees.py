"""The benchmark of the guarantees: what it counts as a violation, and as a loose or missing bound."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.cases import guarantees as bench
from cosim.analysis.adversary import Objective, find_worst
from netem.tc_words import settings_of
from noack.scenario.sections import POLICIES
from tests.oracles.loss_language import is_allowed, outcomes_of


@pytest.mark.parametrize("words", bench.COMBINATIONS)
def test_no_combination_is_violated_and_each_would_be_without_it(
    words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench, "_FLOW_DECISIONS", 200_000)
    for before in ("loss 50%", f"loss 30% {bench.REORDERING}"):
        violations, *rates = bench.check_rows(before, words, 200_000)
        assert violations.value == 0
        assert all(rate.ratio == pytest.approx(1, abs=0.02) for rate in rates)
        free = outcomes_of(bench.decide(f"{before} limit 1000000"))
        assert not is_allowed(free, settings_of(words))


def test_the_check_examines_windows_and_gaps() -> None:
    lost = np.array([1, 1, 0, 1, 0, 0, 1, 0, 0, 0], bool)
    for words, allowed in (("mansd 1", False), ("atmost 2 in 4", False), ("mansd 2 recover 2", False),
                           ("mansd 2 recover 1", True)):  # fmt: skip
        assert is_allowed(lost, settings_of(words)) is allowed


def test_every_policy_that_is_a_rule_is_compared() -> None:
    paper = {"beta": 0.5, "alpha_per_s": 0.25, "floor": 0.0}
    triggers = bench.triggers(paper, np.eye(2)).values()
    names = {trigger["policy"] for trigger in triggers} | {
        trigger["rule"]["policy"] for trigger in triggers if "rule" in trigger
    }
    assert names == {name for name, kind in POLICIES.items() if kind.example(2) is not None}


def test_a_bound_below_the_worst_run_is_reported() -> None:
    loop = bench.loop_named("double_integrator", 2.0, "identity")
    worst = find_worst(loop, Objective.ERROR, beam=0)
    assert worst.certified is not None
    assert worst.value is not None
    row = bench.row_of("double_integrator", worst)
    assert row.holds
    assert 0.1 < (row.value or 0.0) < 1.0
    assert bench.row_of("", replace(worst, certified=worst.value * 0.99)).holds is False


def test_a_missing_certificate_fails() -> None:
    loop = bench.loop_named("double_integrator", 1.0, "identity")
    (row,) = bench.tightness_rows(loop, "relative", {"policy": "relative", "sigma": 5.0})
    assert row.name == "double_integrator, relative: certificates"
    assert row.holds is False
    assert row.note
