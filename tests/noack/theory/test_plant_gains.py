"""Gains of a loop against dense sampling: never below, not far above; and their inequalities."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import expm

from noack.core.linear_systems import Matrix
from noack.theory.bounds.gains import Output, PlantGains
from noack.theory.bounds.terms import NetworkConditions
from noack.theory.bounds.trigger_bounds import first_passage_s
from tests.oracles.lossy_loops import SEARCH, System, systems

SOME = settings(SEARCH, max_examples=6)
ROUNDING = 1 - 1e-9


def norms(C: Matrix, G: Matrix, D: Matrix, t_s: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.linalg.norm(C @ expm(G * t_s[:, None, None]) @ D, 2, axis=(1, 2)))


def slow_s(G: Matrix) -> float:
    return -1.0 / float(np.linalg.eigvals(G).real.max())


def all_times(G: Matrix) -> NDArray[np.float64]:
    fast = float(np.abs(np.linalg.eigvals(G)).max())
    dense = np.geomspace(1e-2 / fast, 12 * slow_s(G), 300)
    return np.unique(np.concatenate([dense, np.linspace(0, 12 * slow_s(G), 500)]))


def outputs_of(system: System) -> dict[Output, Matrix]:
    """The outputs that measure x and e_c, written with K itself."""
    H, K = system.H, system.K
    return {
        Output.STATE: np.eye(len(H)),
        Output.WEIGHTED: system.weight,
        Output.GAIN: K,
        Output.GAIN_RATE: K @ H,
        Output.GAIN_CURVATURE: K @ H @ H,
        Output.MISMATCH: system.weight @ (system.A + system.B @ K - H),
    }


@settings(SOME)
@given(systems(), st.integers(0, 6), st.floats(0, 1))
def test_missing_events_count_what_they_may_have_grown_to(
    system: System, events: int, share: float
) -> None:
    """Σ_j sup_{τ≥jδ} ‖C e^{(H+αI)τ} W⁻¹‖, and ‖C W⁻¹‖ for the present error."""
    error = system.gains().error
    G, inverse = system.H + system.alpha * np.eye(len(system.H)), np.linalg.inv(system.weight)
    t_s, spacing_s = all_times(G), share * slow_s(G)
    for output in error.outputs:
        C = outputs_of(system)[output]
        values = norms(C, G, inverse, t_s)
        sampled = [values[t_s >= j * spacing_s].max(initial=0.0) for j in range(events)]
        found = error.missing(output, events, spacing_s)
        assert found >= sum(sampled) * ROUNDING
        # The cells are coarse; sampling misses the start of a supremum, and late times.
        assert found <= 1.05 * sum(sampled) + 1e-3 * values.max()
        exact = float(np.linalg.norm(C @ inverse, 2))
        assert exact * ROUNDING <= error.now(output) <= exact * (1 + 1e-9)


@settings(SOME)
@given(systems(), st.floats(0.01, 3.0))
def test_an_input_that_is_not_of_now_is_wrong_by_no_more(system: System, reach: float) -> None:
    """‖K(e^{−Hσ} − I + Hσ − ½H²σ²) W⁻¹‖, |σ| ≤ hold: older or newer inputs."""
    error = system.gains().error
    hold_s = reach / float(np.linalg.norm(system.H, 2))
    ages_s = np.linspace(-hold_s, hold_s, 81)
    inverse, H, identity = np.linalg.inv(system.weight), system.H, np.eye(len(system.H))
    for longest_s in (0.3 * hold_s, hold_s):
        sampled = max(
            float(np.linalg.norm(
                system.K @ (expm(-H * s) - identity + H * s - H @ H * s**2 / 2) @ inverse, 2
            ))
            for s in ages_s[np.abs(ages_s) <= longest_s]
        )  # fmt: skip
        found = error.hold_remainder(longest_s)
        assert found >= sampled * ROUNDING
        # σ³/6 sup‖KH³e^{−Hs}W⁻¹‖ bounds the integral; its values need not point in one direction.
        assert found <= (2 if longest_s < 0.5 / np.linalg.norm(system.H, 2) else 20) * sampled
    assert error.hold_remainder(0.0) == 0.0


@settings(SOME)
@given(systems())
def test_the_state_is_at_most_its_free_part_and_gain_times_the_push(system: System) -> None:
    plant = system.gains()
    G = system.A + system.B @ system.K + system.alpha * np.eye(len(system.A))
    t_s = all_times(G)
    # p = K … acts only through the range of K.
    U = np.linalg.svd(system.K, full_matrices=False)[0][:, : np.linalg.matrix_rank(system.K)]
    for output, (free, gain) in plant.states.items():
        C = outputs_of(system)[output]
        sampled = norms(C, G, system.x0[:, None], t_s)
        assert free >= sampled.max() * ROUNDING
        assert free <= 1.01 * sampled.max() + 1e-12
        pushed = norms(C, G, system.B @ U, t_s)
        area = float(np.trapezoid(pushed, t_s))
        assert gain >= area * (1 - 1e-2)  # of 800 trapezoids over curves that rotate
        assert gain <= 1.03 * area + 1e-12


@settings(SOME)
@given(systems(), st.floats(0.01, 1.0))
def test_before_the_start_the_plant_falls_freely(system: System, reach: float) -> None:
    """x = e^{At}x(0) and p = −Kx; afterwards the push has moved x by the added term."""
    plant = system.gains()
    start_s = reach / float(np.linalg.norm(system.A, 2) + 1e-9)
    error, added = plant.start_up(start_s)
    t_s = np.linspace(0, start_s, 60)
    x = (expm(system.A * t_s[:, None, None]) @ system.x0) * np.exp(system.alpha * t_s)[:, None]
    pushes = np.linalg.norm(x @ system.K.T, axis=1)
    assert pushes.max() * ROUNDING <= error <= 1.01 * pushes.max() + 1e-12
    closed = system.A + system.B @ system.K + system.alpha * np.eye(len(system.A))
    later_s = all_times(closed)
    for output, extra in added.items():
        C = outputs_of(system)[output]
        fallen = np.linalg.norm(x @ C.T, axis=1).max()
        moved = C @ (expm(closed * later_s[:, None, None]) @ x[-1][:, None])
        afterwards = np.linalg.norm(moved, axis=(1, 2)).max()
        free = plant.states[output].free
        assert max(fallen, afterwards) <= (free + extra) * (1 + 1e-9) + 1e-12


def passage_s(plant: PlantGains, *values: float) -> float:
    """The first passage of one loop from 0."""
    return float(first_passage_s(plant, *np.array([*values, 0.0])[:, None])[0])


@settings(SOME)
@given(systems(n=2), st.floats(0.01, 3.0), st.floats(0.0, 3.0), st.floats(0.0, 3.0))
def test_the_first_passage_is_that_of_the_volterra_equation(
    system: System, mismatch: float, push: float, own: float
) -> None:
    """ρ(r) = ∫₀^r k_E(s) X + k_B(s) (π' + own ρ(r−s)) ds, marched in small steps, reaches β."""
    plant = system.gains()
    level = system.beta
    found_s = passage_s(plant, level, mismatch, push, own)
    longest_s = 6 * slow_s(system.H + system.alpha * np.eye(len(system.H)))
    assume(found_s < longest_s)  # skipped where the push is almost 0
    G, W = system.H + system.alpha * np.eye(len(system.H)), system.weight
    E = system.A + system.B @ system.K - system.H
    U = np.linalg.svd(system.K, full_matrices=False)[0][:, : np.linalg.matrix_rank(system.K)]
    L = np.linalg.solve(W, np.linalg.svd(W @ E)[0][:, : max(np.linalg.matrix_rank(E), 1)])
    steps = 400
    t_s = np.linspace(0, 1.3 * found_s, steps + 1)
    step_s = float(t_s[1])
    from_x, from_p = norms(W, G, L, t_s), norms(W, G, system.B @ U, t_s)
    rho = np.zeros(steps + 1)
    for k in range(1, steps + 1):  # the trapezoidal rule, with ρ(0) = 0
        fixed = np.trapezoid(from_x[: k + 1] * mismatch + from_p[: k + 1] * push, dx=step_s)
        echo = float(from_p[1:k] @ rho[k - 1 : 0 : -1]) + 0.5 * from_p[0] * rho[k - 1]
        rho[k] = max(fixed + own * step_s * echo, rho[k - 1])
    passed_s = float(np.interp(level, rho, t_s)) if rho[-1] > level else math.inf
    # Never later than the equation's solution, and hardly earlier.
    assert found_s <= passed_s * (1 + 1e-2)
    assert passed_s < math.inf
    assert found_s >= 0.95 * passed_s


def test_without_mismatch_or_push_the_threshold_is_never_reached() -> None:
    system = System(
        A=np.array([[-2.0]]), B=np.array([[1.0]]), K=np.array([[0.0]]), H=np.array([[-2.0]]),
        weight=np.eye(1), x0=np.ones(1), alpha=1.0, beta=0.1, known_start=True, mansd=0,
        step_s=0.01, sample_steps=1, delay_steps=0, hold_steps=0, lag_steps=0,
    )  # fmt: skip
    plant = system.gains()
    assert passage_s(plant, 0.1, 0.0, 0.0, 0.0) >= 1e6
    found = system.certify(NetworkConditions(0))
    assert found.inter_event_s is not None
    assert found.inter_event_s >= 1e6
    # ρ = π'(1 − e^{−t}): never above π', and half of it at ln 2.
    assert passage_s(plant, 0.5, 0.0, 1.0, 0.0) == pytest.approx(math.log(2), rel=0.01)
    assert passage_s(plant, 0.5, 0.0, 1.0, 0.0) <= math.log(2)
    assert passage_s(plant, 1.01, 0.0, 1.0, 0.0) > 4
