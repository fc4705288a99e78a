"""The worst run as values: its share of a certificate's bound."""

from dataclasses import replace

import pytest

from cosim.analysis.adversary.loop_flows import Objective
from cosim.analysis.adversary.worst_run import WorstRun

WORST = WorstRun(
    Objective.STATE, 10.0, value=3.0, at_s=1.0, pattern=(True, False), event_s=(0.5, 1.0), exact=True,
    nodes=4, runs=2, lossless=1.0, with_own_network=2.0, certified=4.0,
)  # fmt: skip


@pytest.mark.parametrize(
    ("objective", "value", "certified", "share", "breaches"),
    [
        (Objective.STATE, 3.0, 4.0, 0.75, False),
        (Objective.STATE, 4.1, 4.0, 1.025, True),
        (Objective.STATE, 4.0 * (1 + 1e-12), 4.0, 1.0, False),  # a rounding error
        (Objective.INTER_EVENT, 0.2, 0.1, 0.5, False),  # the bound is a lower one
        (Objective.INTER_EVENT, 0.05, 0.1, 2.0, True),
        (Objective.STATE, 3.0, None, None, False),
        (Objective.INTER_EVENT, None, 0.1, None, False),
    ],
)
def test_a_run_beyond_the_bound_refutes_the_certificate(
    objective: Objective, value: float | None, certified: float | None, share: float | None, *, breaches: bool
) -> None:
    worst = replace(WORST, objective=objective, value=value, certified=certified)
    assert worst.tightness == (None if share is None else pytest.approx(share))
    assert worst.breaches is breaches
