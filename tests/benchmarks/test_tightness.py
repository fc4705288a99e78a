"""The benchmark of tightness: every policy has a row, and a bound that is too small is seen."""

from dataclasses import replace

import numpy as np

from benchmarks.guarantees import loop_named, row_of, triggers
from cosim.analysis.adversary import Objective, find_worst
from noack.scenario.sections import POLICIES


def test_every_policy_that_is_a_rule_is_compared() -> None:
    paper = {"beta": 0.5, "alpha_per_s": 0.25, "floor": 0.0}
    found = triggers(paper, np.eye(2)).values()
    names = {one["policy"] for one in found} | {
        one["rule"]["policy"] for one in found if "rule" in one
    }
    assert names == {name for name, made in POLICIES.items() if made.example(2) is not None}


def test_a_bound_below_the_worst_run_is_reported() -> None:
    loop = loop_named("double_integrator", 2.0, "identity")
    worst = find_worst(loop, Objective.ERROR, beam=0)
    assert worst.certified is not None
    assert worst.value is not None
    row = row_of("double_integrator", worst)
    assert row.holds
    assert 0.1 < (row.value or 0.0) < 1.0
    assert row_of("", replace(worst, certified=worst.value * 0.99)).holds is False
