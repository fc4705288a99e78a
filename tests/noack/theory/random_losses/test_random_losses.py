"""Loops under random losses: moments and growth, by closed forms, all patterns, Monte Carlo."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.linalg import expm, solve_continuous_lyapunov

from noack.impairments.loss_guarantee import LossGuarantee
from noack.impairments.loss_prediction import LossProcess, OutcomeChain
from noack.impairments.markov_chain import Array, NotPredictableError
from noack.theory.bounds.certificate_terms import NetworkConditions, NoCertificateError
from noack.theory.bounds.gains import ErrorGains, PlantGains
from noack.theory.margins.exact_matrices import IntervalMatrix, exactly
from noack.theory.random_losses import mean_square_growth as mean_square_module
from noack.theory.random_losses import moments as moments_module
from noack.theory.random_losses import random_growth as random_growth_module
from noack.theory.random_losses.fixed_times import mean_squares
from noack.theory.random_losses.moments import BurstCertificate, moment_at_events, moments_of_runs
from noack.theory.random_losses.quadratic_moments import Known, LossyFlow, quadratic_functions
from tests.noack.theory.certificates.certificate_kinds.random_losses import certify, draw, simulate_runs


def mean_square_growth(maps: list[tuple[Array, Array]], chain: OutcomeChain) -> float:
    exact = [(exactly(delivered), exactly(lost)) for delivered, lost in maps]
    return mean_square_module.mean_square_growth(exact, chain)


def sure_growth(delivered: Array, lost: Array, chain: OutcomeChain) -> float:
    return random_growth_module.sure_growth(exactly(delivered), exactly(lost), chain)


def independent(p: float) -> LossProcess:
    return LossProcess(np.ones(1), np.ones((1, 1)), np.array([p]))


def scalar(rate: float, gain: float, mismatch: float) -> PlantGains:
    """x' = −(rate + mismatch) x + p, a model that decays at ``rate``, and u = −gain x_c."""
    one = np.eye(1)
    error = ErrorGains(-rate * one, -gain * one, one, 0.0)
    return PlantGains(error, (gain - rate - mismatch) * one, one, one, 0.0)


@pytest.mark.parametrize("p", [0.1, 0.5, 0.9])
def test_in_a_contracting_norm_the_moments_at_events_are_those_of_the_geometric_law(p: float) -> None:
    error = scalar(2.0, 3.0, 0.0).error
    for order, expected in (1, 1 / (1 - p)), (2, (1 + p) ** 0.5 / (1 - p)):
        found = moment_at_events(error, independent(p), 0.0, order)
        assert found == pytest.approx(expected, rel=1e-6)
        assert moment_at_events(error, independent(p), 0.5, order) < found


@pytest.mark.parametrize("order", [1, 2])
def test_moments_at_events_include_longer_bursts_than_are_counted(
    order: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With three terms, the rest is bounded from above, and not far."""
    error, process = scalar(2.0, 3.0, 0.0).error, losses([0.8, 0.2], [[0.9, 0.1], [0.4, 0.6]], [0.05, 0.8])
    exact = moment_at_events(error, process, 0.0, order)
    monkeypatch.setattr(moments_module, "_TERMS", 3)
    assert exact <= moment_at_events(error, process, 0.0, order) < 1.5 * exact


def test_the_mean_of_the_largest_values_of_runs_by_hand() -> None:
    """Runs whose longest burst is 0, 1 or 2 with probabilities 0.5, 0.3 and 0.2 keep 1, 3 and 4."""
    bursts = [
        BurstCertificate(most, probability, 9, 0.0, 0.5, bound, 10 * bound)
        for most, probability, bound in [(0, 0.5, 1.0), (1, 0.8, 3.0), (2, 1.0, 4.0)]
    ]
    mean, root_mean_square = moments_of_runs(bursts)
    assert mean.controller_error == pytest.approx(0.5 * 1 + 0.3 * 3 + 0.2 * 4)
    assert root_mean_square.controller_error == pytest.approx((0.5 * 1 + 0.3 * 9 + 0.2 * 16) ** 0.5)
    assert root_mean_square.state == pytest.approx(10 * root_mean_square.controller_error)
    assert (mean.most, mean.probability, mean.rate_per_s) == (2, 1.0, 0.5)
    assert moments_of_runs([]) == []


@pytest.mark.parametrize("p", [0.0, 0.01, 0.3, 0.9])
def test_mean_squares_of_a_scalar_loop_are_those_of_the_inequalities_iterated_by_hand(p: float) -> None:
    """π = g|e_c|, |x| = 1 + π/(r + e), |e_c| = β + lost errors, of which all add (e|x| + π)/r."""
    rate, gain, mismatch, beta = 2.0, 1.5, 0.2, 0.1
    plant = scalar(rate, gain, mismatch)
    found = mean_squares(plant.error, plant, NetworkConditions(0), beta, p)
    e_c, powers = beta, p ** np.arange(1.0, 2000)
    for _ in range(2000):
        x = 1.0 + gain * e_c / (rate + mismatch)
        whole = (mismatch * x + gain * e_c) / rate
        tails = np.minimum(1, powers * whole / beta)
        burst = beta * np.sqrt(tails @ (2 * np.arange(len(tails)) + 1))
        e_c = beta + min(np.sqrt(p) * whole, burst)
    assert found.controller_error == pytest.approx(e_c, rel=0.02)
    assert found.state == pytest.approx(x, rel=0.02)
    assert found.input_error == pytest.approx(gain * e_c, rel=0.02)


@pytest.mark.parametrize("late", [False, True], ids=["paper", "schedule"])
def test_no_event_and_no_flow_raises_the_mean_of_a_quadratic_function(late: bool) -> None:
    """Both inequalities of the derivation, written once more, in the coordinates of the loop."""
    rng, p, checked = np.random.default_rng(8), 0.4, 0
    conditions = NetworkConditions(0, 0.01, 0.01, 0.1, 0.05, 0.1) if late else NetworkConditions(0)
    for _ in range(4):
        loop = draw(rng, alpha_share=0.3, probability=p)
        gains, H, K, W = loop.system.gains(), loop.system.H, loop.system.K, loop.system.weight
        n, flow = len(H), LossyFlow(gains.error, gains, conditions, p)
        one, zero = np.eye(n), np.zeros((n, n))
        x, q, e_s, w, v_f, v_h = np.split(np.eye(6 * n), 6)  # v is B (w + v_f + v_h) of the derivation
        B = loop.system.B @ gains.error.split_K[0]
        R, pushed = gains.error.split_K[1], np.pad(B, ((0, 0), (0, n - B.shape[1])))
        G, shift = loop.system.A + loop.system.B @ K, gains.alpha_per_s * one
        entering = loop.system.B @ K @ (q + e_s) + late * pushed @ (w + v_f + v_h)
        rates = (
            (G + shift) @ x + entering, (H + shift) @ q, (H + shift) @ e_s - (G - H) @ x - entering,
        )  # fmt: skip
        aged = conditions.hold_s * R @ H @ (x + q + e_s)
        for V in quadratic_functions(flow, Known(loop.system.beta, loop.system.beta * late, 0.0, 0.0)):
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
            both, D = np.hstack([one, one]), zero
            for t in np.linspace(0, conditions.delay_s, 400)[:-1]:
                remaining = np.exp(V.rate_per_s * t) * R @ expm((H + shift) * t)
                D = D + remaining.T @ remaining * conditions.delay_s / 400
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
    assert flow.flight(rate_per_s) == pytest.approx(expected, rel=1e-6)


CONTINUOUS_LATE = NetworkConditions(0, delay_s=0.04)


@pytest.mark.parametrize(
    ("gain", "unit", "p", "conditions"),
    [
        (-1.5, 1.0, 0.3, CONTINUOUS_LATE),
        (0.0, 1.0, 1.0, NetworkConditions(0)),
        (-1.5, 1e8, 0.3, NetworkConditions(0, 0.02, 0.02, 0.04, 0.04, 0.04)),
    ],
    ids=["events may be arbitrarily close", "all updates are lost", "no function is found"],
)
def test_mean_squares_without_a_quadratic_function_are_those_of_the_inequalities(
    gain: float, unit: float, p: float, conditions: NetworkConditions
) -> None:
    error = ErrorGains(-np.eye(1), np.array([[gain / unit]]), np.eye(1), 0.2)
    plant = PlantGains(error, np.array([[-1.2 - gain]]), np.array([[unit]]), np.array([[unit]]), 0.2)
    args = error, plant, conditions, 0.1 * unit, p
    found, first = mean_squares(*args, refined=True), mean_squares(*args)
    assert found.state <= first.state
    assert found.controller_error <= first.controller_error


def test_inputs_that_are_too_old_for_the_fastest_mode_have_no_moments() -> None:
    """e^{−Hσ} overflows."""
    error = ErrorGains(-np.diag([1.0, 1e6]), np.array([[-0.1, -0.1]]), np.eye(2), 0.2)
    plant = PlantGains(error, -np.diag([1.0, 1e6]), np.zeros((2, 1)), np.ones((2, 1)), 0.2)
    with np.errstate(all="ignore"), pytest.raises(NoCertificateError, match="overflow"):
        mean_squares(error, plant, NetworkConditions(0, hold_s=0.007), 0.1, 0.3)


def test_moments_at_a_lower_rate_than_the_triggers() -> None:
    """Random loops without moments at the trigger's rate, against their runs."""
    share, compared = 1e-3, 0
    for seed in range(14):
        rng = np.random.default_rng(seed)
        loop = draw(rng, mismatch=0.5, alpha_share=0.8)  # half of them have none
        slower = replace(loop, system=replace(loop.system, alpha=share * loop.system.alpha))
        if certify(loop) is not None or (bounds := certify(slower)) is None:
            continue
        compared += 1
        for name, worst in simulate_runs(loop, rng, share).worst.items():
            assert worst <= bounds[name], (seed, name)
    assert compared >= 3


def losses(start: list[float], moves: list[list[float]], lost: list[float]) -> LossProcess:
    return LossProcess(np.array(start), np.array(moves), np.array(lost))


def unlimited(process: LossProcess) -> OutcomeChain:
    return process.outcomes(LossGuarantee())


BURSTY = losses([0.8, 0.2], [[0.9, 0.1], [0.4, 0.6]], [0.05, 0.8])


@pytest.mark.parametrize("p", [0.0, 0.2, 0.6, 1.0])
def test_a_scalar_grows_as_the_mean_of_its_squares(p: float) -> None:
    found = mean_square_growth([(np.array([[0.5]]), np.array([[1.4]]))], unlimited(independent(p)))
    assert found == pytest.approx(((1 - p) * 0.25 + p * 1.96) ** 0.5, rel=1e-6)


@pytest.mark.parametrize("process", [independent(0.4), BURSTY], ids=["independent", "bursty"])
def test_the_second_moment_of_all_patterns_grows_like_the_spectral_radius(
    process: LossProcess,
) -> None:
    """With two slots; the sum over all patterns of 14 periods, divided by that of 12."""
    rng = np.random.default_rng(3)
    slots = [(rng.normal(size=(2, 2)), rng.normal(size=(2, 2))) for _ in range(2)]
    fates = process.moves * (1 - process.lost), process.moves * process.lost

    def second_moment(periods: int) -> float:
        total = 0.0
        for pattern in product([0, 1], repeat=periods):
            weight: Array = process.start
            matrix = np.eye(2)
            for period, lost in enumerate(pattern):
                weight, matrix = weight @ fates[lost], slots[period % 2][lost] @ matrix
            total += float(weight.sum() * (matrix**2).sum())
        return total

    grown = (second_moment(12) / second_moment(10)) ** 0.25
    assert mean_square_growth(slots, unlimited(process)) == pytest.approx(grown, rel=0.01)


@pytest.mark.parametrize("process", [independent(0.5), BURSTY], ids=["independent", "bursty"])
def test_almost_all_runs_of_a_scalar_grow_as_the_mean_of_the_logarithm(
    process: LossProcess,
) -> None:
    """Jensen's bound, the root of the mean square, is above 1; nevertheless runs decay."""
    delivered, lost = np.array([[0.2]]), np.array([[2.5]])
    chain = unlimited(process)
    share = float(chain.distribution() @ chain.lost.sum(axis=1))
    exact = 0.2 ** (1 - share) * 2.5**share
    assert sure_growth(delivered, lost, chain) == pytest.approx(exact, rel=1e-6)
    assert exact < 1 < mean_square_growth([(delivered, lost)], chain)


@pytest.mark.parametrize("process", [independent(0.6), BURSTY], ids=["independent", "bursty"])
def test_almost_all_runs_of_random_loops_grow_at_most_by_the_bound(process: LossProcess) -> None:
    """40 runs of 2,000 periods, minus six standard errors; the bound is above by 4 % at most."""
    chain, slack, exceeded = unlimited(process), [], False
    fewer = unlimited(replace(process, lost=process.lost / 2))  # a broken copy
    for seed in (1, 2, 3, 5):  # the search for a bound takes long in others
        rng = np.random.default_rng(seed)
        delivered, lost = 0.7 * rng.normal(size=(2, 3, 3))
        maps, n = np.array([delivered, lost]), len(chain.lost)
        steps = np.cumsum(np.hstack([chain.delivered, chain.lost]), axis=1)
        z, state, grown = rng.normal(size=(40, 3)), np.full(40, n - 1), np.zeros(40)
        for _ in range(2000):
            step = (rng.uniform(size=(40, 1)) > steps[state]).sum(axis=1).clip(max=2 * n - 1)
            state = step % n
            z = np.einsum("kij,kj->ki", maps[step // n], z)
            size = np.linalg.norm(z, axis=1)
            grown, z = grown + np.log(size) / 2000, z / size[:, None]
        bound, error = np.log(sure_growth(delivered, lost, chain)), grown.std() / np.sqrt(40)
        assert bound > grown.mean() - 6 * error
        assert bound <= np.log(mean_square_growth([(delivered, lost)], chain)) + 1e-6
        slack.append(bound - grown.mean())
        exceeded = exceeded or np.log(sure_growth(delivered, lost, fewer)) < grown.mean() - 6 * error
    assert np.median(slack) < 0.04
    assert exceeded


def test_growth_does_not_depend_on_units_and_holds_for_fast_modes() -> None:
    """States in units that differ by 2^60, and maps with eigenvalues from 1e-9 to 1."""
    rng = np.random.default_rng(5)
    units, chain = np.ldexp(1.0, [0, 30, -30]), unlimited(independent(0.3))
    for fastest in (1.0, 1e-9):
        M0, M1 = (fastest * rng.normal(size=(3, 3)) + 0.5 * np.eye(3)[0] for _ in range(2))
        turned = [units[:, None] * one / units for one in (M0, M1)]
        for found, expected in (
            (mean_square_growth([(turned[0], turned[1])], chain),
             mean_square_growth([(M0, M1)], chain)),
            (sure_growth(turned[0], turned[1], chain), sure_growth(M0, M1, chain)),
        ):  # fmt: skip
            assert found == pytest.approx(expected, rel=1e-5)
    with pytest.raises(NotPredictableError, match="beyond 1e308"):
        mean_square_growth([(np.eye(2), np.full((2, 2), np.inf))], chain)


def test_a_spectral_radius_that_was_computed_too_small_is_not_accepted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    maps, chain = [(0.5 * np.eye(2), np.diag([1.4, 0.3]))], unlimited(BURSTY)
    assert mean_square_growth(maps, chain) > 0
    values = np.linalg.eigvals
    monkeypatch.setattr(np.linalg, "eigvals", lambda matrix: 0.999 * values(matrix))
    with pytest.raises(NotPredictableError, match="bounded numerically"):
        mean_square_growth(maps, chain)


@pytest.mark.parametrize("radius", [0.0, 1e-9])
def test_a_bound_of_the_second_moments_is_proven_with_all_rounding(radius: float) -> None:
    """x becomes ax with |a| ≤ 0.7 + radius, and has another state that nothing moves."""
    size, chain = 0.7 + radius, unlimited(independent(0.4)).recurrent()
    M = IntervalMatrix(np.diag([0.7, 0.0]), np.diag([radius, 1e-16]))
    maps = mean_square_module.PeriodMaps([(np.array([[0.7]]), np.array([[0.7]]))], [(M, M)])
    forms = np.ones((len(chain.lost), 1, 1))
    assert maps.prove_below(size**2 * (1 + 1e-12), forms, chain)
    assert not maps.prove_below(size**2 * (1 - 1e-15), forms, chain)


def test_a_tilted_bound_contains_the_rounding_of_the_frequencies(monkeypatch: pytest.MonkeyPatch) -> None:
    """An inverse that is known to 1e-6 only makes the bound larger by as much times the weights."""
    delivered, lost, chain = np.array([[0.2]]), np.array([[2.5]]), unlimited(BURSTY)
    exact, inverse = sure_growth(delivered, lost, chain), random_growth_module.inverse

    def inaccurate(matrix: Array) -> IntervalMatrix | None:
        found = inverse(matrix)
        return found and IntervalMatrix(found.middle, found.radius + 1e-6)

    monkeypatch.setattr(random_growth_module, "inverse", inaccurate)
    assert 1e-7 < sure_growth(delivered, lost, chain) / exact - 1 < 1e-4
