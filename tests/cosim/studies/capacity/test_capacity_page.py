"""The sentences of a capacity study: which policy carries more loops, and how many mixtures."""

from unittest.mock import Mock

import numpy as np
import pytest

from cosim.studies.capacity.capacity_page import CapacityResult, comparison_sentences, mixture_sentences
from cosim.studies.capacity.capacity_plan import OWN
from cosim.studies.capacity.capacity_result import Capacity, PolicyCapacity
from tests.cosim.studies.capacity.conftest import LOOP, plan_of


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
    plan = plan_of(LOOP, (1, 9))
    carried = {"periodic": Capacity(4.0, 3.0, 6.0), "model": Capacity(ends[0], *ends)}
    both = [PolicyCapacity(policy, OWN, {}, capacity) for policy, capacity in carried.items()]
    (sentence,) = comparison_sentences(CapacityResult(plan, Mock(), both, []))
    assert sentence.startswith(f"model against periodic, as in the scenario: {outcome}")


@pytest.mark.parametrize(
    ("median", "expected"),
    [
        (2.0, "1 × the given mixture (1 a, 1 b)"),
        (np.inf, "at least 2 × the given mixture (2 a, 2 b)"),
        (0.0, "0 × the given mixture; 1 a, 1 b already reach a limit"),
    ],
)
def test_a_capacity_of_several_kinds_is_a_multiple_of_the_mixture(median: float, expected: str) -> None:
    plan = plan_of("loops=[{ name = 'a' }, { name = 'b' }]", (2, 4))
    carried = PolicyCapacity("model", "own", {}, Capacity(median, 0.0, np.inf))
    (sentence,) = mixture_sentences(CapacityResult(plan, Mock(), [carried], []))
    assert sentence == f"model, disturbance own: {expected}"
