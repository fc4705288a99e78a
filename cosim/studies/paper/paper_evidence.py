"""The page's evidence on the paper's assumptions and errors: computed examples, counterexamples.

Each function returns numbers for the page, from the exact simulator or from linear algebra.
"""

import itertools
import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
from scipy.linalg import schur
from scipy.optimize import brentq

from cosim.record.align import align_tables
from cosim.simulation.continuous import (
    ContinuousLoop,
    ContinuousRun,
    continuous_loop_of,
    run_continuous,
    simulate_continuous,
)
from cosim.simulation.virtual_time import simulate
from cosim.studies.campaign.random_draws import box_of, drawn_scenario
from noack.core.clock import NS_PER_S
from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix, Vector, spectral_abscissa
from noack.plants.linear import lane_following
from noack.protocol.record_tables import SENSOR_MEASUREMENT, entry_names
from noack.scenario.resolution import LoopMatrices, loop_of
from noack.scenario.scenario import Scenario
from noack.theory.bounds.certificate_terms import Constants
from noack.theory.certificates.conditions import ideal_conditions
from noack.theory.certificates.scenario_certificates import certify
from noack.theory.paper import InterEventTrajectory, longest_interval_s, theorem_1, theorem_2
from noack.trigger_policies.trigger_rule import TriggerRule, error_form

Numbers = dict[str, object]
Mode = Literal["model", "zoh"]
MODES: tuple[Mode, ...] = ("model", "zoh")
"""The loops of the page: MB-ET and ZOH-ET."""
SEED = 0
"""Seed of the campaign ``paper``."""
CERTIFIED_DRAWS = range(25)
"""Draws with certificates, each of which takes about a second."""
_DELIVERY_DRAWS = 100
"""Number of draws whose states at deliveries are compared."""
_MOST_TRIED = 100
"""Draws among which an unstable plant is looked for."""
_EXACT_MODEL_S, _SAMPLED_S = 300.0, 20.0
"""Lengths of the run with an exact model, and of the one whose trigger is sampled."""
_SAMPLES = 101
"""Samples of an interval between two events."""
_SAMPLES_FOR_BOUNDS, _SAMPLES_FOR_OVERSHOOT = 4001, 2001
"""Samples of a run in which ‖e_c‖ and ‖x‖ are compared with their bounds; and of a longer one in which
the largest ‖x‖ is looked for."""
_ROUNDING = 1e-12
"""Smaller numbers are rounding errors, which depend on the machine."""
_ZERO = 1e-6
"""An eigenvalue of smaller magnitude is taken as 0: the lane's double eigenvalue 0 is defective."""


def resolved_draw(scenario: Scenario, draw: int, mode: Mode) -> Scenario:
    """Return a draw of the campaign as a resolved scenario; draw i has the same plant in both."""
    return drawn_scenario(scenario.model_copy(update={"mode": mode}), SEED, draw)


def open_loop_eigenvalues(A: Matrix) -> Vector:
    """Return the eigenvalues of A, (n,); eigenvalues that are 0 up to rounding are set to 0.

    A defective double eigenvalue splits by about the square root of the rounding error.
    """
    eigenvalues = np.linalg.eigvals(A)
    tolerance = math.sqrt(np.finfo(float).eps) * max(float(np.linalg.norm(A, 2)), 1.0)
    return np.where(np.abs(eigenvalues) < tolerance, 0.0, eigenvalues)


def evidence(
    scenario: Scenario, draws: int, representative: int, certified: Sequence[int] = CERTIFIED_DRAWS
) -> Numbers:
    """Return all numbers of the page's sections on assumptions and errors, as JSON.

    Args:
        scenario: that of the base; its plant and initial state are not yet drawn.
        draws: number of draws.
        representative: the draw that is the example.
        certified: the draws below this number that are certified, besides the example.
    """
    M, trigger = scenario.network.mansd + 1, scenario.decaying
    return {
        "example": {"M": M, "beta": trigger.beta, "alpha_per_s": trigger.alpha_per_s},
        "eigenvalues": _eigenvalues(),
        "plants": _plants(scenario, draws),
        "growth": _growth(scenario, min(draws, _DELIVERY_DRAWS)),
        "certificates": _certificates(scenario, [draw for draw in certified if draw < draws], representative),
        "loss": _loss(M),
        "exact_model": _exact_model(scenario),
        "without_growth": _without_growth(scenario),
        "slow_model": _slow_model(M),
        "standstill": _standstill(scenario),
        "overshoot": _overshoot(scenario, representative),
        "theorem_1": _theorem_1(scenario, representative),
        "theorem_3": _theorem_3(scenario, representative),
        "sampled": _sampled(scenario, representative),
    }


def _eigenvalues() -> Numbers:
    """Return the numbers of the example as printed, and with the other sign of U."""
    values: Numbers = {}
    for name, speed in (("printed", -12.0), ("flipped", 12.0)):
        model = lane_following(speed=speed)
        eigenvalues = np.linalg.eigvals(model.A + model.B @ model.K)
        values[name] = sorted([value.real, value.imag] for value in eigenvalues.tolist())
    A = lane_following().A
    values["open"] = sorted(open_loop_eigenvalues(A).real.tolist())
    values["rank"] = int(np.linalg.matrix_rank(A))
    values["rank_squared"] = int(np.linalg.matrix_rank(A @ A))
    return values


def _plants(scenario: Scenario, draws: int) -> Numbers:
    """Return the largest real parts of the eigenvalues of A and of A + BK over the plants."""
    K = loop_of(resolved_draw(scenario, 0, "model")).K
    plants = box_of(scenario).population(SEED, range(draws))
    opened = np.array([open_loop_eigenvalues(A).real.max() for A in plants.A])
    closed = np.array([spectral_abscissa(A + B @ K) for A, B in zip(*plants[:2], strict=True)])
    return {
        "not_unstable": float((opened <= 0).mean()),
        "fastest_open_per_s": float(opened.max()),
        "closed_per_s": [float(closed.min()), float(closed.max())],
        "unstabilised": int((closed > -scenario.decaying.alpha_per_s).sum()),
    }


def _growth(scenario: Scenario, draws: int) -> Numbers:
    """Return the number of stretches between deliveries, and in how many of them ‖x‖ grows."""
    growth: Numbers = {"draws": draws}
    for mode in MODES:
        runs = [run_continuous(resolved_draw(scenario, draw, mode)) for draw in range(draws)]
        norms = [np.linalg.norm([state.x for state in run.before], axis=1) for run in runs]
        rises = [np.diff(n[run.delivered]) > 0 for n, run in zip(norms, runs, strict=True)]
        growth[mode] = {"stretches": sum(map(len, rises)), "growing": sum(int(rise.sum()) for rise in rises)}
    return growth


def _certificates(scenario: Scenario, draws: Sequence[int], representative: int) -> Numbers:
    """Return how near MB-ET comes to its certified bounds, and Theorem 2's δ̲.

    Raises:
        CallerError: the representative draw has no certificate.
    """
    rows, theorems = dict[int, dict[str, float]](), list[dict[str, float]]()
    for draw in dict.fromkeys([*draws, representative]):
        resolved = resolved_draw(scenario, draw, "model")
        constants = certify(resolved, ideal_conditions(resolved)).constants
        if constants is None:
            continue
        run, trigger = run_continuous(resolved), resolved.decaying
        samples = run.at(np.linspace(0.0, run.reached_s, _SAMPLES_FOR_BOUNDS))
        growth = np.exp(trigger.alpha_per_s * samples.t_s)
        # e_c jumps at a delivery, so its largest value may come just before.
        e_c_before = np.array([state.e_c for state in run.before[1:]]).reshape(-1, run.system.loop.n)
        at_events = run.system.norms(e_c_before) * np.exp(trigger.alpha_per_s * run.event_s[1:])
        error = max((run.e_c_norm(samples) * growth).max(), at_events.max(initial=0.0))
        rows[draw] = {
            "error": error / trigger.beta,
            "delta": constants.delta,
            "state": (np.linalg.norm(samples.x, axis=1) * growth).max() / constants.state,
            "inter_event": np.diff(run.event_s).min() / (constants.inter_event_s or math.nan),
        }
        theorems += _theorem_2(resolved, constants)
    if representative not in rows:
        raise CallerError(f"{scenario.name}: the representative draw {representative} has no certificate")
    return {
        "draws": len(rows.keys() - {representative}),
        "error": max(row["error"] / row["delta"] for row in rows.values()),
        "state": max(row["state"] for row in rows.values()),
        "inter_event": min(row["inter_event"] for row in rows.values()),
        "representative": rows[representative],
        "theorem_2": {
            "draws": len(theorems),
            "negative": sum(row["negative"] for row in theorems),
            **{
                name: [f(row[name] for row in theorems) for f in (min, max)]
                for name in ("first_s", "inter_event_s")
            },
        },
    }


def _theorem_2(resolved: Scenario, constants: Constants) -> list[dict[str, float]]:
    """Return Theorem 2 with the certified Δ: eq:tau at t_i = 0, and its smallest value.

    ``negative`` is 1 if F̄ < 0, so that eq:tau falls with t_i. Without the theorem there is no row.
    """
    trigger = resolved.decaying
    theorem = theorem_2(loop_of(resolved), trigger.beta, trigger.alpha_per_s, constants.delta)
    if theorem is None:
        return []
    start = theorem.a_tilde * (theorem.state_start - theorem.state_forced)  # F̄
    gap = theorem.alpha_bar_per_s - trigger.alpha_per_s
    forced = (gap / theorem.c + theorem.a_tilde) * theorem.state_forced  # F
    rate = theorem.a_hat + theorem.alpha_bar_per_s
    F = start / rate + forced / (theorem.a_hat + trigger.alpha_per_s)
    first_s = math.log1p(trigger.beta / F) / rate if F > 0 else math.inf
    return [{"inter_event_s": theorem.inter_event_s, "first_s": first_s, "negative": int(start < 0)}]


def _loss(M: int) -> Numbers:
    """Return loss rates for a loss probability p if at most M − 1 dropouts are successive.

    On average a delivery needs 1 + p + … + p^(M−1) transmissions.
    """
    roots = np.roots([*[1.0] * (M - 1), -1.0])
    (half,) = roots[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)].real
    return {"half": float(half), "at_0.8": 1 - 1 / sum(0.8**k for k in range(M)), "most": (M - 1) / M}


def _exact_model(scenario: Scenario) -> Numbers:
    """Proposition 1 fails for an exact model: the nominal lane, only the first packet delivered."""
    resolved = resolved_draw(_nominal(scenario, _EXACT_MODEL_S), 0, "model")
    run = _only_first_arrives(resolved)
    loop = loop_of(resolved)
    eigenvalues, vectors = np.linalg.eig(loop.H)
    BK, identity = loop.B @ loop.K, np.eye(loop.n)
    deviations = [
        float(np.linalg.norm(np.linalg.solve(value * identity - loop.A, BK @ chi) - chi))
        for value, chi in zip(eigenvalues, vectors.T, strict=True)
    ]
    times_s = [0.0, 10.0, 20.0, 30.0]
    return {
        "horizon_s": _EXACT_MODEL_S,
        "events": len(run.event_s),
        "times_s": times_s,
        "norms": np.linalg.norm(run.at(times_s).x, axis=1).tolist(),
        "apart": max(*deviations, _ROUNDING),
    }


def _without_growth(scenario: Scenario) -> Numbers:
    """Return the dimensions of the set of x with (x, x) in the span of Γ's stable modes.

    "model" and "zoh" count eigenvalues 0 as stable (no exponential growth), "strictly" does not.

    Raises:
        CallerError: no plant is unstable.
    """
    for draw in range(_MOST_TRIED):
        loop = loop_of(resolved_draw(scenario, draw, "model"))
        if unstable := int((open_loop_eigenvalues(loop.A).real > _ZERO).sum()):
            break
    else:
        raise CallerError(f"{scenario.name}: none of {_MOST_TRIED} drawn plants is unstable")
    return {
        "draw": draw,
        "n": loop.n,
        "unstable": unstable,
        "model": _dimension_without_growth(loop, loop.H, _ZERO),
        "zoh": _dimension_without_growth(loop, np.zeros_like(loop.H), _ZERO),
        "strictly": _dimension_without_growth(loop, loop.H, -_ZERO),
    }


def _dimension_without_growth(loop: LoopMatrices, H: Matrix, least_real: float) -> int:
    """Return the dimension of the x for which (x, x) excites no mode of Γ with a larger real part.

    Γ = [[A, BK], [0, H]]. The rows of the left invariant subspace of these modes vanish on such a
    pair.
    """
    gamma = np.block([[loop.A, loop.B @ loop.K], [np.zeros_like(H), H]])

    def beyond(real: float, imaginary: float) -> bool:
        return real > least_real

    _, basis, modes = schur(gamma.T, sort=beyond)
    rows = basis[:, :modes].T
    return loop.n - int(np.linalg.matrix_rank(rows[:, : loop.n] + rows[:, loop.n :], tol=_ZERO))


def _slow_model(M: int) -> Numbers:
    """No Δ holds for all times: a model decays more slowly than the threshold, M − 1 of M are lost.

    The first state has an exact model, so it causes no events. In the second state the model's pole
    is −0.1 and the plant's pole is −1. α = 0.5 is below A + BK's decay rate 1. A has the distinct
    eigenvalues 1 and −1, as the paper requires.
    """
    A, model = np.diag([1.0, -1.0]), np.diag([1.0, -0.1])
    B, K = np.eye(2)[:, :1], np.array([[-3.0, 0.0]])
    trigger = TriggerRule(error_form(2), 1.0, 0.5)
    loop = LoopMatrices(
        A_model=model, B_model=B, K=K, H=model + B @ K, A=A, B=B, x0=np.array([1.0, 5.0]),
        weight=None, state_names=entry_names("x", 2), input_names=entry_names("u", 1),
    )  # fmt: skip
    run = simulate_continuous(
        ContinuousLoop(loop, trigger),
        horizon_s=250.0,
        delivered=lambda event: event % M == 0,
        known_start=False,
    )
    ends = [state for i, state in enumerate(run.before) if i % M == 0 and i > 0]
    return {
        "alpha_per_s": trigger.rate_per_s,
        "closed_per_s": -spectral_abscissa(A + B @ K),
        "model_per_s": -spectral_abscissa(loop.H),
        "deliveries_s": [state.t_s for state in ends],
        "thresholds": [
            float(np.linalg.norm(state.e_c)) * math.exp(trigger.rate_per_s * state.t_s) for state in ends
        ],
        "first_ratios": (np.diff(run.event_s)[1:5] / run.event_s[1:5]).tolist(),
    }


def _standstill(scenario: Scenario) -> Numbers:
    """A hold without growth: the nominal lane comes to rest away from the lane, and stays there.

    K x(0) = 0, and (V, r) decays along A's stable direction until ψ = 0. Then nothing moves.
    """
    resolved = resolved_draw(_nominal(scenario, scenario.horizon_s), 0, "zoh")
    loop, trigger = loop_of(resolved), resolved.decaying
    eigenvalues, vectors = np.linalg.eig(loop.A[:2, :2])
    slowest = int(np.argmin(eigenvalues))
    rate, lateral = float(eigenvalues[slowest]), vectors[:, slowest]
    lateral = -0.3 * lateral / lateral[0]
    yaw = lateral[1] / rate  # ψ(∞) = ψ(0) − r(0)/λ = 0
    x0 = np.array([*lateral, yaw, -yaw * loop.K[0, 2] / loop.K[0, 3]])
    run = _only_first_arrives(resolved, x0)
    last = run.before[-1]
    times_s = [0.0, 2.0, 10.0, 20.0, 30.0]
    return {
        "x0": x0.tolist(),
        "stable_per_s": rate,
        "ratio": -rate / trigger.alpha_per_s,
        "events_s": run.event_s.tolist(),
        "times_s": times_s,
        "norms": np.linalg.norm(run.at(times_s).x, axis=1).tolist(),
        "thresholds": float(np.linalg.norm(last.e_c)) / run.system.threshold(last.t_s),
    }


def _overshoot(scenario: Scenario, representative: int) -> dict[str, list[float]]:
    """Return sup ‖x‖ / ‖x(0)‖ for a sequence of decreasing x(0)."""
    scales = (1.0, 1e-2, 1e-4)
    scenario = scenario.model_copy(update={"horizon_s": 100.0})
    overshoots: dict[str, list[float]] = {"scales": list(scales), "model": [], "zoh": []}
    for mode, scale in itertools.product(MODES, scales):
        resolved = resolved_draw(scenario, representative, mode)
        start = tuple(scale * value for value in resolved.plant.initial_state)
        plant = resolved.plant.model_copy(update={"initial_state": start})
        run = run_continuous(resolved.model_copy(update={"plant": plant}))
        norms = np.linalg.norm(run.at(np.linspace(0, run.reached_s, _SAMPLES_FOR_OVERSHOOT)).x, axis=1)
        overshoots[mode].append(float(norms.max() / norms[0]))
    return overshoots


def _theorem_1(scenario: Scenario, representative: int) -> Numbers:
    """Return Theorem 1's Δ of each interval between deliveries, with the best γ and η_j."""
    run = run_continuous(resolved_draw(scenario, representative, "model"))
    trigger, H = run.system.decaying, run.system.loop.H
    arrived = np.flatnonzero(run.delivered)
    deltas, closest = [], []
    for first, following in itertools.pairwise(arrived.tolist()):
        longest = [_longest_s(run, j) for j in range(first + 1, following)]
        deltas.append(theorem_1(H, trigger.rate_per_s, longest))
        closest += (np.array(longest) / np.diff(run.event_s[first + 1 : following + 1])).tolist()
    return {"stretches": len(deltas), "largest": max(deltas), "interval_ratio": max(closest)}


def _longest_s(run: ContinuousRun, event: int) -> float:
    """Return δ̄_j of the interval after an event, from the trajectory."""
    trigger = run.system.decaying
    t_s = np.linspace(run.event_s[event], run.event_s[event + 1], _SAMPLES)
    samples = run.system.sample(run.after[event], t_s)
    interval = InterEventTrajectory(
        t_s, np.linalg.norm(samples.x, axis=1), np.linalg.norm(samples.x_s, axis=1)
    )
    return longest_interval_s(interval, trigger.level, trigger.rate_per_s, trigger.rate_per_s)


def _theorem_3(scenario: Scenario, representative: int) -> Numbers:
    """Compare eq:zohnume as printed with the factor from its derivation, along a run.

    It uses γ of the nominal plant and η_j = ‖x(t_j)‖, the largest that the theorem permits.
    """
    run = run_continuous(resolved_draw(scenario, representative, "zoh"))
    beta, alpha_per_s = run.system.decaying.level, run.system.decaying.rate_per_s
    gamma = float(open_loop_eigenvalues(lane_following().A).real.max())

    def solved_s(eta: float, level: float) -> float:
        def excess(delta_s: float) -> float:
            return eta * math.expm1(gamma * delta_s) - level * math.exp(-alpha_per_s * delta_s)

        return float(brentq(excess, 0.0, 1e3))

    rows = []
    for event in np.searchsorted(run.event_s, (0.0, 10.0, 20.0, 30.0)):
        state = run.after[event]
        eta = float(np.linalg.norm(state.x))
        derived_s = solved_s(eta, beta * math.exp(-alpha_per_s * state.t_s))
        row = {"t_s": state.t_s, "norm": eta}
        rows.append(row | {"printed": solved_s(eta, beta), "derived": derived_s})
    return {"gamma_per_s": gamma, "rows": rows}


def _sampled(scenario: Scenario, representative: int) -> Numbers:
    """Return the same draw with a trigger that is evaluated at sampling times only."""
    scenario = scenario.model_copy(update={"horizon_s": _SAMPLED_S})
    resolved = resolved_draw(scenario, representative, "model")
    continuous = run_continuous(resolved)
    record = simulate(resolved)
    aligned = align_tables(record)
    tested = record[SENSOR_MEASUREMENT]["event"] > 0  # event 0 happens without a test
    ratios = aligned.e_s_norm[tested] / aligned.threshold[tested]
    exact = continuous.at(aligned.t_ns / NS_PER_S)
    return {
        "horizon_s": _SAMPLED_S,
        "period_s": resolved.timing.measurement_period_ns / NS_PER_S,
        "events": int(tested.sum()) + 1,
        "events_continuous": len(continuous.event_s),
        "beyond": float(ratios.max()),
        "rms": math.sqrt(float(((aligned.x - exact.x) ** 2).sum(axis=1).mean())),
    }


def _only_first_arrives(resolved: Scenario, x0: Vector | None = None) -> ContinuousRun:
    return simulate_continuous(
        continuous_loop_of(resolved),
        horizon_s=resolved.horizon_s,
        delivered=lambda event: event == 0,
        known_start=False,
        x0=x0,
    )


def _nominal(scenario: Scenario, horizon_s: float) -> Scenario:
    """Return the scenario with the nominal plant and its nominal initial state."""
    plant = scenario.plant.model_copy(update={"draw": "nominal", "initial_state_halfwidth": None})
    return scenario.model_copy(update={"plant": plant, "horizon_s": horizon_s})
