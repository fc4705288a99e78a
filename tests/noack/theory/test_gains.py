"""Gains of a loop against dense sampling: never below, and not far above."""

import numpy as np
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import expm

from noack.linear import Matrix
from noack.theory.gains import ErrorGains, Output, PlantGains
from tests.noack.theory.loops import System, systems

SEARCH = settings(
    deadline=None, suppress_health_check=list(HealthCheck), phases=[Phase.generate], max_examples=25
)

ROUNDING = 1 - 1e-9


def gains(system: System) -> tuple[ErrorGains, PlantGains]:
    error = ErrorGains(system.H, system.K, system.weight, system.alpha)
    return error, PlantGains(error, system.A, system.B, system.x0[:, None], system.alpha)


def norms(C: Matrix, G: Matrix, D: Matrix, t_s: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.linalg.norm(C @ expm(G * t_s[:, None, None]) @ D, 2, axis=(1, 2)))


def slow_s(G: Matrix) -> float:
    return -1.0 / float(np.linalg.eigvals(G).real.max())


def all_times(G: Matrix) -> NDArray[np.float64]:
    fast = float(np.abs(np.linalg.eigvals(G)).max())
    dense = np.geomspace(1e-2 / fast, 12 * slow_s(G), 300)
    return np.unique(np.concatenate([dense, np.linspace(0, 12 * slow_s(G), 500)]))


def outputs_of(system: System) -> dict[Output, Matrix]:
    """Through which x and e_c are looked at, written with K itself."""
    H, K = system.H, system.K
    return {
        Output.STATE: np.eye(len(H)),
        Output.WEIGHTED: system.weight,
        Output.GAIN: K,
        Output.GAIN_RATE: K @ H,
        Output.MISMATCH: system.A + system.B @ K - H,
    }


@settings(SEARCH)
@given(systems(), st.integers(0, 6), st.floats(0, 1))
def test_missing_events_count_what_they_may_have_grown_to(
    system: System, events: int, share: float
) -> None:
    """Σ_j sup_{τ≥jδ} ‖C e^{(H+αI)τ} W⁻¹‖, and ‖C W⁻¹‖ for the present error."""
    error, _ = gains(system)
    G, inverse = system.H + system.alpha * np.eye(len(system.H)), np.linalg.inv(system.weight)
    t_s, spacing_s = all_times(G), share * slow_s(G)
    for output in error.outputs:
        C = outputs_of(system)[output]
        values = norms(C, G, inverse, t_s)
        sampled = [values[t_s >= j * spacing_s].max(initial=0.0) for j in range(events)]
        found = error.missing(output, events, spacing_s)
        assert found >= sum(sampled) * ROUNDING
        # Sampling misses where a supremum begins, and what is beyond twelve time constants.
        assert found <= 1.03 * sum(sampled) + 1e-3 * values.max()
        exact = float(np.linalg.norm(C @ inverse, 2))
        assert exact * ROUNDING <= error.now(output) <= exact * (1 + 1e-9)


@settings(SEARCH)
@given(systems(), st.floats(0.01, 3.0))
def test_an_input_that_is_not_of_now_is_wrong_by_no_more(system: System, reach: float) -> None:
    """‖K(e^{−Hσ} − I + Hσ) W⁻¹‖ for |σ| ≤ hold: models behind and, of a late plant, ahead."""
    error, _ = gains(system)
    hold_s = reach / float(np.linalg.norm(system.H, 2))
    ages_s = np.linspace(-hold_s, hold_s, 81)
    inverse, identity = np.linalg.inv(system.weight), np.eye(len(system.H))
    for longest_s in (0.3 * hold_s, hold_s):
        sampled = max(
            float(np.linalg.norm(
                system.K @ (expm(-system.H * age_s) - identity + system.H * age_s) @ inverse, 2
            ))
            for age_s in ages_s[np.abs(ages_s) <= longest_s]
        )  # fmt: skip
        found = error.hold_remainder(longest_s)
        assert found >= sampled * ROUNDING
        # ½σ² sup‖KH²e^{−Hs}W⁻¹‖ is the integral's bound: its values all of one direction.
        assert found <= (1.6 if longest_s < 0.5 / np.linalg.norm(system.H, 2) else 12) * sampled
    assert error.hold_remainder(0.0) == 0.0


@settings(SEARCH)
@given(systems())
def test_the_state_is_at_most_its_free_part_and_gain_times_the_push(system: System) -> None:
    _, plant = gains(system)
    G = system.A + system.B @ system.K + system.alpha * np.eye(len(system.A))
    t_s = all_times(G)
    # p = K … acts through the range of K only.
    U = np.linalg.svd(system.K, full_matrices=False)[0][:, : np.linalg.matrix_rank(system.K)]
    for output, (free, gain) in plant.states.items():
        C = outputs_of(system)[output]
        sampled = norms(C, G, system.x0[:, None], t_s)
        assert free >= sampled.max() * ROUNDING
        assert free <= 1.01 * sampled.max() + 1e-12
        pushed = norms(C, G, system.B @ U, t_s)
        area = float(np.trapezoid(pushed, t_s))
        assert gain >= area * (1 - 1e-2)  # of 800 trapezoids over curves that turn
        assert gain <= 1.03 * area + 1e-12


@settings(SEARCH)
@given(systems(), st.floats(0.01, 1.0))
def test_before_the_start_the_plant_falls_freely(system: System, reach: float) -> None:
    """x = e^{At}x(0) and p = −Kx; afterwards the push has moved x by what is added."""
    _, plant = gains(system)
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


@settings(SEARCH)
@given(systems(), st.floats(0.01, 2.0))
def test_growth_between_two_tests(system: System, reach: float) -> None:
    """e^{(H+αI)τ} of a sampled error, of E x, of B p: each against its own convolution."""
    _, plant = gains(system)
    G = system.H + system.alpha * np.eye(len(system.H))
    until_s = reach / float(np.linalg.norm(G, 2))
    growth = plant.growth(until_s, 64)
    t_s, W = np.linspace(0, until_s, 400), system.weight
    start = norms(W, G, np.linalg.inv(W), t_s)
    stretch = plant.error.stretch(until_s)
    assert start.max() * ROUNDING <= stretch <= 1.001 * start.max()
    rng = np.random.default_rng(5)
    E = system.A + system.B @ system.K - system.H
    for kernel, D in ((growth.mismatch, E), (growth.input_error, system.B @ system.K)):
        # Any signal v of the bounded size that the kernel goes with: ‖D v‖ in units of ‖D v‖.
        v = rng.normal(size=(len(system.H), 1))
        size = float(np.linalg.norm(D @ v)) if kernel is growth.mismatch else float(
            np.linalg.norm(system.K @ v)
        )  # fmt: skip
        area = float(np.trapezoid(norms(W, G, D @ v, t_s), t_s))
        assert area <= kernel.integral_on_grid() * size * (1 + 1e-4) + 1e-15
