"""The quadratic functions: their inequalities and the effect of updates in flight, written once more."""

import numpy as np
import pytest
from scipy.linalg import expm, solve_continuous_lyapunov

from noack.theory.bounds.certificate_terms import NetworkConditions
from noack.theory.bounds.gains import ErrorGains, PlantGains
from noack.theory.random_losses.stochastic_lyapunov import KnownRms, LossyFlow, quadratic_functions
from tests.noack.theory.certificates.certificate_kinds.random_losses import draw
from tests.noack.theory.certificates.certified_loops import gains_of


@pytest.mark.parametrize("late", [False, True], ids=["paper", "schedule"])
def test_no_event_and_no_flow_raises_the_mean_of_a_quadratic_function(late: bool) -> None:
    """Both inequalities of the derivation, written once more, in the coordinates of the loop."""
    rng, p, checked = np.random.default_rng(8), 0.4, 0
    conditions = NetworkConditions(0, 0.01, 0.01, 0.1, 0.05, 0.1) if late else NetworkConditions(0)
    for _ in range(4):
        loop = draw(rng, alpha_share=0.3, probability=p)
        gains, H, K, W = gains_of(loop.system), loop.system.H, loop.system.K, loop.system.weight
        n, flow = len(H), LossyFlow(gains.error, gains, conditions, p)
        identity, zero = np.eye(n), np.zeros((n, n))
        x, q, e_s, w, v_f, v_h = np.split(np.eye(6 * n), 6)  # v is B (w + v_f + v_h) of the derivation
        B = loop.system.B @ gains.error.split_K[0]
        R, pushed = gains.error.split_K[1], np.pad(B, ((0, 0), (0, n - B.shape[1])))
        G, shift = loop.system.A + loop.system.B @ K, gains.alpha_per_s * identity
        entering = loop.system.B @ K @ (q + e_s) + late * pushed @ (w + v_f + v_h)
        rates = (
            (G + shift) @ x + entering, (H + shift) @ q, (H + shift) @ e_s - (G - H) @ x - entering,
        )  # fmt: skip
        aged = conditions.hold_s * R @ H @ (x + q + e_s)
        times_s = np.linspace(0, conditions.delay_s, 400)[:-1, None, None]
        in_flight = R @ expm((H + shift) * times_s)
        for V in quadratic_functions(flow, KnownRms(loop.system.beta, loop.system.beta * late, 0.0, 0.0)):
            checked += 1
            P = np.kron(np.eye(2), W).T @ V.errors @ np.kron(np.eye(2), W)
            P[n:, n:] -= V.added * W.T @ W
            form = np.block([[W.T @ V.state @ W, zero, zero], [np.zeros((2 * n, n)), P]])
            z, moved = np.vstack([x, q, e_s]), np.vstack(rates)
            grown = z.T @ form @ moved + moved.T @ form @ z + 2 * V.rate_per_s * z.T @ form @ z
            zeta, zeta_f, zeta_h = V.of_inputs
            allowed = V.of_sensor_error * e_s.T @ W.T @ W @ e_s + zeta * w.T @ w + zeta_f * v_f.T @ v_f
            allowed += zeta_h * (v_h.T @ v_h - aged.T @ aged)
            used = np.flatnonzero(np.abs(grown).sum(axis=0) + np.abs(allowed).sum(axis=0))
            difference = (allowed - grown)[np.ix_(used, used)]
            assert np.linalg.eigvalsh(difference)[0] > -1e-9 * np.linalg.norm(difference)
            both, remaining = np.hstack([identity, identity]), np.exp(V.rate_per_s * times_s) * in_flight
            D = (remaining.swapaxes(1, 2) @ remaining).sum(axis=0) * conditions.delay_s / 400
            at_event = P - both.T @ (p * P[:n, :n] + 0.98 * zeta_f * D) @ both
            assert np.linalg.eigvalsh(at_event)[0] > -1e-9 * np.linalg.norm(at_event)
    assert checked > 8


def test_the_effect_of_updates_in_flight_is_that_of_its_equation_for_fast_modes() -> None:
    """MᵀD + DM = e^{Mᵀd} KᵀK e^{Md} − KᵀK, with a mode whose e^{−Mᵀd} is near 10⁴³."""
    modes = np.array([[1.0, 1.0], [0.3, 1.0]])
    H = modes @ np.diag([-1.0, -1000.0]) @ np.linalg.inv(modes)
    K, B, delay_s, rate_per_s = np.array([[-0.15, -0.09]]), np.array([[0.3], [1.0]]), 0.1, 0.3
    error = ErrorGains(H, K, np.eye(2), 0.2)
    plant = PlantGains(error, H - B @ K, B, np.ones((2, 1)), 0.2)
    flow = LossyFlow(error, plant, NetworkConditions(0, 0.01, 0.01, delay_s), 0.3)
    M = H + (0.2 + rate_per_s) * np.eye(2)
    moved = K @ expm(M * delay_s)
    expected = solve_continuous_lyapunov(M.T, moved.T @ moved - K.T @ K)
    assert flow.effect_in_flight(rate_per_s) == pytest.approx(expected, rel=1e-6)
