"""The models' flow with changing set-points, against the flow of the deviations by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from noack.core.linear_systems import ModelFlow, Propagator

H = np.array([[0.0, 1.0], [-1.0, -1.5]])
X = np.array([1.0, -0.5])


def test_without_a_set_point_it_is_the_propagator_bit_for_bit() -> None:
    flow = ModelFlow(H)
    flow.change(5, None)
    assert not flow.moved
    assert flow(X, 3, 10**9).tobytes() == Propagator(H)(X, 10**9 - 3).tobytes()


def test_the_model_converges_to_the_set_point() -> None:
    x_r = np.array([2.0, 0.0])
    flow = ModelFlow(H, x_r)
    assert flow(x_r, 0, 10**9).tolist() == x_r.tolist()
    assert flow(X, 0, 40 * 10**9) == pytest.approx(x_r, abs=1e-9)


@given(st.lists(st.integers(0, 5 * 10**9), min_size=2, max_size=8))
def test_changes_on_the_way_are_taken_where_they_are(times: list[int]) -> None:
    *inner, end_ns = sorted(times)
    flow, by_hand, now_ns, x_r = ModelFlow(H), X, 0, np.zeros(2)
    for number, t_ns in enumerate(inner):
        by_hand = x_r + expm(H * (t_ns - now_ns) * 1e-9) @ (by_hand - x_r)
        now_ns, x_r = t_ns, np.array([float(number), 0.0])
        flow.change(t_ns, x_r)
    by_hand = x_r + expm(H * (end_ns - now_ns) * 1e-9) @ (by_hand - x_r)
    assert flow(X, 0, end_ns) == pytest.approx(by_hand, abs=1e-9)
