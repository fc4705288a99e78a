"""Designs for a network: what ``noack design --for network`` says of the given and the best loop.

With periodic updates each growth is compared with repeated patterns, as for margins, on the level
that is reached and on the next one; the cost is integrated anew. With events, the bounds for the
largest M are compared with runs. The searches are short: what they say is attacked, not how good
they are.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np

from cosim.studies.design import event_design
from cosim.studies.design.event_design import CertifiedEventLoop, EventSearch
from cosim.studies.design.network_search import CertifiedLoop, DesignRequest, NetworkSearch
from noack.scenario.resolution import loop_of, resolve
from noack.scenario.scenario import Scenario
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from tests.noack.theory.certificates.certificate_kinds import Bounds, Broken, Kind, Observed
from tests.noack.theory.certificates.certificate_kinds.decaying import search as search_losses
from tests.noack.theory.certificates.certificate_kinds.margins import growth_shares, random_scenario
from tests.noack.theory.certificates.certificate_kinds.policies import FAR, policy_shares, scenario_of
from tests.noack.theory.certificates.certificate_kinds.shares import Case
from tests.oracles.lossy_loops import System, Trace, random_system
from tests.oracles.time_triggered_loops import LoopMaps

Rng = np.random.Generator


class Wanted(NamedTuple):
    """A loop and what is asked for."""

    scenario: Scenario
    request: DesignRequest
    system: System | None = None
    """The same loop, with events."""


class Design(NamedTuple):
    """What is said of both loops with periodic updates."""

    search: NetworkSearch
    given: CertifiedLoop
    best: CertifiedLoop

    def maps(self, loop: CertifiedLoop, level: int) -> LoopMaps:
        """Return a loop at a level."""
        resolved = resolve(self.search.scenario_of(loop.candidate, level))
        return LoopMaps(resolved, self.search.requirements[max(level, 0)].period_ns)


class EventDesign(NamedTuple):
    """What is said of the best loop with events."""

    search: EventSearch
    best: CertifiedEventLoop
    certificate: ScenarioCertificate


def _random_periodic(rng: Rng, **fixed: Any) -> Wanted:
    scenario, unit_ns, *_ = random_scenario(
        rng,
        **({"n": int(rng.choice([1, 1, 2])), "periodic": True, "rate_per_s": rng.uniform(-0.1, 1)} | fixed),
    )
    n, m = np.shape(scenario.model.B)
    weights = np.diag(10 ** rng.uniform(-1, 1, n)), np.diag(10 ** rng.uniform(-1, 1, m))
    fewest = rng.random() < 0.2
    window = None if fewest or rng.random() < 0.7 else int(rng.integers(2, 6))
    most = int(rng.integers(2, 7))
    request = DesignRequest(
        "transmissions" if fewest else "network", window, most=None if fewest or window else most,
        weights=weights, cost=float(rng.choice([1.0, 1.2, 3.0])), effort=int(rng.integers(16)),
    )  # fmt: skip
    horizon_s = 4e-9 * unit_ns if fewest else 1.0  # the longest period
    return Wanted(scenario.model_copy(update={"horizon_s": horizon_s}), request)


def _random_events(rng: Rng, **fixed: Any) -> Wanted:
    """The certificate is that of the loop's own plant, or of a box which just contains it."""
    given = {
        "n": int(rng.integers(1, 3)), "m": 1, "sample_steps": int(rng.integers(1, 4)), "mansd": 0,
        "delay_steps": int(rng.integers(3)), "hold_steps": 1, "lag_steps": 0, "known_start": False,
        "window": (1, 1), "recovery": 0, "beta": float(rng.choice([0.001, 0.01, 0.1])),
    }  # fmt: skip
    system = random_system(rng, **(given | fixed))
    step_ns = round(system.step_s * 1e9)
    system, rate_hz = replace(system, step_s=step_ns * 1e-9), 1e9 / step_ns
    change = np.abs(system.A - (system.H - system.B @ system.K)) * (1 + 1e-9)
    box = {"draw": "vertex", "uncertainty_A": change.tolist()} if rng.random() < 0.5 else {}
    scenario = scenario_of(
        system,
        {"beta": system.beta, "alpha_per_s": system.alpha, "weight": system.weight.tolist()},
        plant={"rate_hz": rate_hz, "measure_every": system.sample_steps, **box},
        controller={"rate_hz": rate_hz}, network={"loss": {"model": "bernoulli", "probability": 0.5}},
        certificate={"late_periods": 0, "network_delay_s": system.delay_steps * system.step_s},
    )  # fmt: skip
    return Wanted(scenario, DesignRequest(most=int(rng.integers(1, 5)), effort=0), system)


def _designed(wanted: Wanted) -> Design | EventDesign | None:
    """Search, briefly; None: nothing is certified."""
    if wanted.system is None:
        search = NetworkSearch(wanted.scenario, wanted.request)
        design = Design(search, *search.run())
        return design if design.best.stability else None
    with patch.multiple(event_design, COSTS_OF_INPUT=(1.0,), _ALPHAS=(0.5,)):
        events = EventSearch(wanted.scenario, wanted.request, 0, draws=4)
        events.certificate = cache(events.certificate)  # type: ignore[method-assign]
        _, best = events.run()
    certificate = events.certificate(best.loop, best.m) if best.m else None
    if certificate is None or certificate.constants is None:
        return None
    return EventDesign(events, best, certificate)


def _certify(case: Case, change: Callable[[Any], Any] = lambda design: design) -> Bounds | None:
    design = _designed(case.loop)
    if design is None:
        return None
    case.certified = change(design)
    if isinstance(design, EventDesign):
        return dict.fromkeys(("e_s", "e_c", "x", "1/δ"), 1.0)
    return {"growth": 1.0, "pattern": 1.0, "cost": 1 + 1e-6, "level": 1.0, "limit": 1 + 1e-6}


def _simulate(case: Case, rng: Rng) -> Observed:
    wanted, design = case.loop, case.certified
    if isinstance(design, EventDesign):
        return _simulate_events(wanted.system, design, rng)
    worst, runs = dict.fromkeys(("growth", "pattern", "cost", "limit"), 0.0), 0
    worst["level"] = (design.given.level + 2) / (design.best.level + 2)
    if design.best != design.given:
        worst["limit"] = design.best.cost / design.search.cost_limit
    for point in (design.given, design.best):
        cost = design.maps(point, point.level).cost(design.search.plant.x0, *design.search.weights)
        if cost != point.cost:  # both may be infinite
            worst["cost"] = max(worst["cost"], cost / point.cost, point.cost / cost)
        for level, stability in ((point.level, point.stability), (point.level + 1, point.beyond)):
            if stability is not None:
                tried, shares = growth_shares(design.maps(point, level), stability, rng)
                runs, worst = runs + tried, worst | {name: max(shares[name], worst[name]) for name in shares}
    return Observed(runs, worst)


def _simulate_events(given: System, design: EventDesign, rng: Rng) -> Observed:
    """The plant is on the edge of the box; without a certificate of the box it is the one drawn."""
    certificate, (K, alpha, beta) = design.certificate, design.best.loop
    drawn = loop_of(resolve(design.search.scenario_of(design.best.loop, design.best.m)))
    system = replace(
        given, A=given.A if design.search.of_box else drawn.A, alpha=alpha, beta=beta,
        K=np.array(K), H=given.H + given.B @ (np.array(K) - given.K),
        mansd=design.best.m - 1, delay_steps=int(certificate.conditions.delay_s / given.step_s + 1e-6),
    )  # fmt: skip

    def worst(system: System, trace: Trace) -> dict[str, float]:
        return policy_shares(trace, certificate, system)

    return search_losses(system, rng, worst_of=worst)


def _one_level_further(design: Design) -> Design:
    level = min(design.best.level + 1, len(design.search.requirements) - 1)
    return design._replace(best=design.best._replace(level=level, beyond=None))


def _given_gain(design: Design) -> Design:
    return design._replace(best=design.best._replace(candidate=design.given.candidate, beyond=None))


def _given_hold(design: Design) -> Design:
    candidate = design.best.candidate._replace(hold=design.given.candidate.hold)
    return design._replace(best=design.best._replace(candidate=candidate, beyond=None))


def _no_cost_of_inputs(design: Design) -> Design:
    Q, R = design.search.weights
    with patch.object(design.search, "weights", (Q, 0 * R)):
        cost = design.search.cost(design.best.candidate, design.best.level)
    return design._replace(best=design.best._replace(cost=cost))


def _one_loss_less(design: EventDesign) -> EventDesign:
    certificate = design.search.certificate(design.best.loop, max(design.best.m - 1, 1))
    assert certificate is not None
    return design._replace(certificate=certificate)


DESIGNS = Kind(
    "design", lambda rng: Case((_random_events if rng.random() < 0.1 else _random_periodic)(rng)),
    _certify, _simulate,
    {
        mistake: Broken(partial(_certify, change=change), lambda rng, draw=draw: Case(draw(rng)))
        for mistake, change, draw in (
            # The first one is tried by pytest: it is the quickest to be detected.
            ("no cost of inputs", _no_cost_of_inputs, _random_periodic),
            ("one level further", _one_level_further, partial(_random_periodic, rate_per_s=1.0)),
            ("the gain of the given loop", _given_gain, _random_periodic),
            ("the hold of the given loop", _given_hold, _random_periodic),
            ("one loss less, with events", _one_loss_less, partial(_random_events, **FAR)),
        )
    },
)  # fmt: skip
