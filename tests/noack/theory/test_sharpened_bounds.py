"""The flow between two deliveries, against runs in exact continuous time and against samples."""

from collections.abc import Iterator

import numpy as np
from hypothesis import given, settings
from scipy.linalg import expm

from noack.core.linear_systems import Matrix
from noack.theory.bounds.gains import Output
from noack.theory.bounds.terms import Constants, NetworkConditions
from noack.theory.certificates.delivery_flow import Reach, bend_of_error, errors_after_losses
from noack.theory.certificates.invariant_ellipsoids import InvariantEllipsoids
from tests.noack.theory.exact_loops import observe
from tests.oracles.lossy_loops import (
    ROUNDING,
    SEARCH,
    System,
    seeds,
    systems,
)

SIGNALS = ("e_s", "x", "x_W", "E x", "p", "e_c", "inter-event time")


def weighted(**changes: object) -> System:
    """A loop whose bounds come from the flow."""
    values = {
        "A": np.array([[0.0, 1.0], [2.0, -0.5]]), "B": np.array([[0.0], [1.0]]),
        "K": np.array([[-6.0, -3.0]]), "H": np.array([[0.1, 1.0], [-3.6, -3.4]]),
        "weight": np.array([[2.0, 0.4], [0.0, 0.5]]), "x0": np.array([0.4, -0.2]),
        "alpha": 0.3, "beta": 0.1, "known_start": True, "mansd": 3, "step_s": 0.01,
        "sample_steps": 1, "delay_steps": 0, "hold_steps": 0, "lag_steps": 0,
    }  # fmt: skip
    return System(**(values | changes))  # type: ignore[arg-type]


def shares(system: System, found: Constants, seed: int) -> dict[str, float]:
    """The largest share of each bound that runs use; above 1, the bound is exceeded."""
    E, largest = system.A + system.B @ system.K - system.H, dict.fromkeys(SIGNALS, 0.0)
    W = system.weight
    for run, samples in observe(system, 12.0, seed):
        growth = np.exp(system.alpha * samples.t_s)
        if not system.known_start:  # before event 0 sensor and controller do not agree
            growth[len(growth) - len(run.before)] = 0.0
        for name, values, bound in (
            ("e_s", samples.e_s @ W.T, found.overshoot * system.beta),
            ("x", samples.x, found.state),
            ("x_W", samples.x @ W.T, found.state_weighted),
            ("E x", samples.x @ (W @ E).T, found.mismatch),
            ("p", samples.e_c @ system.K.T, found.input_error),
            ("e_c", samples.e_c @ W.T, found.delta * system.beta),
        ):
            size = float((growth * np.linalg.norm(values, axis=1)).max())
            largest[name] = max(largest[name], size / max(bound, 1e-12))
        if len(run.before) > 1:
            share = (found.inter_event_s or 0.0) / float(np.diff(run.event_s).min())
            largest["inter-event time"] = max(largest["inter-event time"], share)
    return largest


def test_the_flow_makes_the_bounds_much_smaller_and_runs_come_close_to_them() -> None:
    system = weighted()
    sharp = system.certify(NetworkConditions(3))
    plain = system.certify(NetworkConditions(3), structured=False)
    assert sharp.state < 0.6 * plain.state
    assert sharp.mismatch < 0.6 * plain.mismatch
    assert (sharp.inter_event_s or 0.0) > 1.3 * (plain.inter_event_s or 0.0)
    used = shares(system, sharp, 1)
    assert max(used.values()) <= ROUNDING
    assert {name for name, share in used.items() if share < 0.6} == set()


def followed(reach: Reach) -> Iterator[Matrix]:
    """z(τ) as columns, from starts that meet both conditions up to τ, for many τ.

    They are scaled until one condition holds with equality; τ goes beyond the grid.
    """
    flow, angles = reach.starts.flow, np.linspace(0.0, np.pi, 181)
    xi = np.vstack([np.cos(angles), np.sin(angles)])
    xi *= reach.size / np.linalg.norm(reach.starts.shape @ xi, axis=0)
    step_s = float(flow.edges_s[-1]) / 400
    leap, z = expm(flow.generator * step_s), np.vstack([xi, 0 * xi])
    largest = np.full(len(angles), 1e-300)
    for _ in range(600):
        z = leap @ z
        largest = np.maximum(largest, np.linalg.norm(z[flow.n :], axis=0))
        scale = np.minimum(1.0, reach.limit / largest)
        yield z * scale


@settings(SEARCH, max_examples=4)
@given(systems(n=2, beta=0.3, mismatch=0.5, known_start=True), seeds)
def test_what_follows_a_delivery_is_bounded(system: System, seed: int) -> None:
    plant = system.gains()
    limit = 3 * system.beta
    reach = InvariantEllipsoids(plant, limit).within(limit)
    if reach is None:
        return
    C = np.random.default_rng(seed).normal(size=(2, 4))
    bound, sampled, sizes = reach.sup(C), 0.0, 0.0
    for z in followed(reach):
        sampled = max(sampled, float(np.linalg.norm(C @ z, axis=0).max()))
        sizes = max(sizes, float(np.linalg.norm(reach.starts.shape @ z[:2], axis=0).max()))
    assert sampled <= bound * ROUNDING
    assert bound <= 2.5 * sampled
    assert sizes <= reach.size * ROUNDING  # no x leaves the ellipsoid
    smaller = Reach(reach.starts, reach.size / 4, limit)
    if smaller.is_invariant():  # only if it is
        for z in followed(smaller):
            size = float(np.linalg.norm(smaller.starts.shape @ z[:2], axis=0).max())
            assert size <= smaller.size * ROUNDING


@settings(SEARCH, max_examples=4)
@given(systems(n=2, beta=0.3, mismatch=0.5, known_start=True), seeds)
def test_what_follows_lost_events_is_bounded(system: System, seed: int) -> None:
    plant, beta, lost = system.gains(), system.beta, 3
    plain = beta * np.arange(1.0, lost + 2) * plant.error.kernels[Output.WEIGHTED].sup()
    ellipsoids = InvariantEllipsoids(plant, float(plain[-1]))
    reach = ellipsoids.within(float(plain[-1]))
    if reach is None:
        return
    flow = ellipsoids.flow
    angles = np.linspace(0.0, 2 * np.pi, 400)
    xi = reach.size * reach.starts.inverse @ np.vstack([np.cos(angles), np.sin(angles)])
    step_s = float(flow.edges_s[-1]) / 4000
    leap, forget = expm(flow.generator * step_s), expm(flow.H * step_s)
    z, missed = np.vstack([xi, 0 * xi]), np.zeros_like(xi)
    events, since_s = np.zeros(len(angles), dtype=int), np.zeros(len(angles))
    largest, spacing_s, size = np.zeros(lost + 1), np.inf, beta
    for _ in range(4000):  # every event is lost
        z, missed, since_s = leap @ z, forget @ missed, since_s + step_s
        e_c = z[flow.n :]
        np.maximum.at(
            largest, events.clip(max=lost), np.linalg.norm(e_c, axis=0) * (events <= lost)
        )
        e_s = np.linalg.norm(e_c - missed, axis=0)
        is_event, size = e_s >= beta, max(size, float(e_s[events <= lost].max(initial=0.0)))
        spacing_s = min(spacing_s, float(since_s[is_event & (events <= lost)].min(initial=np.inf)))
        missed[:, is_event], since_s[is_event] = e_c[:, is_event], 0.0
        events += is_event
    if not np.isfinite(spacing_s):
        return
    kernel = plant.error.kernels[Output.WEIGHTED]
    # An event is seen at the next node of the grid; until then e_s grows further.
    apart_s, plain = max(spacing_s - step_s, step_s), plain * size / beta
    bend = bend_of_error(reach, beta)
    found = errors_after_losses(reach, plain, size, beta, apart_s, kernel, bend)
    assert (largest <= found * ROUNDING).all()
