"""Designs for a network: what ``noack design --for network`` says about the given and the best loop.

With periodic updates each growth is compared with repeated patterns, as for margins, on the rung that
is reached and on the next one; the cost is integrated anew. With events, the bounds for the largest
M are compared with simulated runs. The searches are short: what is attacked is what they say.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np

from cosim.studies.design import event_design
from cosim.studies.design.event_design import Certified, EventSearch
from cosim.studies.design.network_search import NetworkSearch, Reached, Wish
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.margins.loss_margin import Stability
from tests.noack.theory.certificate_kinds import Bounds, Broken, Kind, Observed
from tests.noack.theory.certificate_kinds.decaying import search
from tests.noack.theory.certificate_kinds.margins import LoopMaps, random_scenario, worst_pattern
from tests.noack.theory.certificate_kinds.policies import FAR, policy_shares, scenario_of
from tests.noack.theory.certificate_kinds.shares import Case
from tests.oracles.lossy_loops import System, random_system

_FEW_STARTS = {"COSTS_OF_INPUT": (1.0,), "_ALPHAS": (0.5,)}


class Wanted(NamedTuple):
    """A loop with periodic updates, and what is asked for."""

    scenario: Scenario
    wish: Wish


class WantedEvents(NamedTuple):
    """A loop with events, and what is asked for."""

    system: System
    scenario: Scenario
    wish: Wish


class Growth(NamedTuple):
    """What is said of a loop with periodic updates and one guarantee."""

    scenario: Scenario
    period_ns: int
    stability: Stability | None
    cost: float | None
    """Without losses; None: nothing is said."""


class Design(NamedTuple):
    """What is said of both loops."""

    search: NetworkSearch
    given: Reached
    best: Reached

    def growths(self) -> list[Growth]:
        """Return what is said of both loops on their rungs and on the next ones."""
        found = []
        for one in (self.given, self.best):
            for rung, stability in ((one.rung, one.stability), (one.rung + 1, one.beyond)):
                rung, cost = max(rung, 0), one.cost if rung == one.rung else None
                if rung < len(self.search.ladder):
                    scenario = self.search.scenario_of(one.candidate, rung)
                    found.append(Growth(scenario, self.search.ladder[rung].period_ns, stability, cost))
        return found


class EventDesign(NamedTuple):
    """What is said of the best loop with events."""

    system: System
    certificate: ScenarioCertificate
    search: EventSearch
    best: Certified


def _random_periodic(rng: np.random.Generator) -> Wanted:
    scenario, unit_ns, *_ = random_scenario(
        rng, n=int(rng.choice([1, 1, 2])), periodic=True, rate_per_s=rng.uniform(-0.1, 1)
    )
    n, m = np.shape(scenario.model.B)
    weights = np.diag(10 ** rng.uniform(-1, 1, n)), np.diag(10 ** rng.uniform(-1, 1, m))
    is_rate = rng.random() < 0.2
    window = None if is_rate or rng.random() < 0.7 else int(rng.integers(2, 6))
    wish = Wish(
        "transmissions" if is_rate else "network", window, most=int(rng.integers(2, 7)),
        weights=weights, cost=float(rng.choice([1.0, 1.2, 3.0])), effort=int(rng.integers(16)),
    )  # fmt: skip
    horizon_s = 4e-9 * unit_ns if is_rate else 1.0
    return Wanted(scenario.model_copy(update={"horizon_s": horizon_s}), wish)


def _random_events(rng: np.random.Generator, **fixed: Any) -> WantedEvents:
    given = {
        "n": int(rng.integers(1, 3)), "m": 1, "sample_steps": int(rng.integers(1, 4)), "mansd": 0,
        "delay_steps": int(rng.integers(3)), "hold_steps": 1, "lag_steps": 0, "known_start": False,
        "window": (1, 1), "recovery": 0, "beta": float(rng.choice([0.001, 0.01, 0.1])),
    }  # fmt: skip
    system = random_system(rng, **(given | fixed))
    step_ns = round(system.step_s * 1e9)
    system, rate_hz = replace(system, step_s=step_ns * 1e-9), 1e9 / step_ns
    change = np.abs(system.A - (system.H - system.B @ system.K))
    box = {"draw": "vertex", "uncertainty_A": (change * (1 + 1e-9)).tolist()} if rng.random() < 0.5 else {}
    trigger = {"beta": system.beta, "alpha_per_s": system.alpha, "weight": system.weight.tolist()}
    scenario = scenario_of(
        system, trigger, plant={"rate_hz": rate_hz, "measure_every": system.sample_steps, **box},
        controller={"rate_hz": rate_hz}, network={"loss": {"model": "bernoulli", "probability": 0.5}},
        certificate={"late_periods": 0, "network_delay_s": system.delay_steps * system.step_s},
    )  # fmt: skip
    return WantedEvents(system, scenario, Wish(most=int(rng.integers(1, 5)), effort=0))


def _designed(wanted: Wanted | WantedEvents) -> Design | EventDesign | None:
    """Search, briefly; None: nothing is certified."""
    if isinstance(wanted, Wanted):
        search = NetworkSearch(*wanted)
        found = Design(search, *search.run())
        return found if found.best.stability else None
    with patch.multiple(event_design, **_FEW_STARTS):
        search = EventSearch(wanted.scenario, wanted.wish, 0, draws=4)
        search.certificate = cache(search.certificate)
        _, best = search.run()
    certificate = search.certificate(best.loop, best.m) if best.m else None
    if certificate is None or certificate.constants is None:
        return None
    (K, alpha_per_s, beta), old = best.loop, wanted.system
    H, delay_s = old.H + old.B @ (np.array(K) - old.K), certificate.conditions.delay_s
    system = replace(
        old, K=np.array(K), H=H, alpha=alpha_per_s, beta=beta, mansd=best.m - 1,
        delay_steps=int(delay_s / old.step_s + 1e-6),
    )  # fmt: skip
    return EventDesign(system, certificate, search, best)


def _certified(
    case: Case, change: Callable[[Design | EventDesign], Design | EventDesign] = lambda found: found
) -> Bounds | None:
    found = _designed(case.loop)
    if found is None:
        return None
    case.found = change(found)
    if isinstance(found, EventDesign):
        return dict.fromkeys(("e_s", "e_c", "x", "1/δ"), 1.0)
    return {"growth": 1.0, "pattern": 1.0, "cost": 1 + 1e-6, "rung": 1.0, "limit": 1 + 1e-6}


def _simulate(case: Case, rng: np.random.Generator) -> Observed:
    found: Design | EventDesign = case.found
    if isinstance(found, EventDesign):
        return search(
            found.system, rng, worst_of=lambda system, trace: policy_shares(trace, found.certificate, system)
        )
    runs, shares = 0, {"rung": (found.given.rung + 2) / (found.best.rung + 2), "limit": 0.0}
    shares |= dict.fromkeys(("growth", "pattern", "cost"), 0.0)
    if found.best.candidate != found.given.candidate:
        shares["limit"] = found.best.cost / found.search.limit
    for one in found.growths():
        loop = LoopMaps(resolve(one.scenario), one.period_ns)
        if one.cost is not None:
            cost = loop.cost(found.search.plant.x0, *found.search.weights)
            if max(cost, one.cost) < np.inf or cost != one.cost:
                shares["cost"] = max(shares["cost"], cost / one.cost, one.cost / cost)
        if one.stability is not None:
            tried, *worst = worst_pattern(loop, rng)
            runs += tried
            shares["growth"] = max(shares["growth"], loop.growth_limits(*worst)[0] / one.stability.upper)
            shares["pattern"] = max(shares["pattern"], one.stability.lower / loop.growth_of(one.stability))
    return Observed(runs, shares)


def _broken(change: Callable[[Any], Any], draw: Callable[[np.random.Generator], Any]) -> Broken:
    return Broken(partial(_certified, change=change), lambda rng: Case(draw(rng)))


def _one_rung_further(found: Design) -> Design:
    rung = min(found.best.rung + 1, len(found.search.ladder) - 1)
    return found._replace(best=found.best._replace(rung=rung, beyond=None))


def _given_gain(found: Design) -> Design:
    return found._replace(best=found.best._replace(candidate=found.given.candidate, beyond=None))


def _no_cost_of_inputs(found: Design) -> Design:
    (Q, R), search = found.search.weights, found.search
    with patch.object(search, "weights", (Q, 0 * R)):
        cost = search.cost(found.best.candidate, found.best.rung)
    return found._replace(best=found.best._replace(cost=cost))


def _one_loss_less(found: EventDesign) -> EventDesign:
    certificate = found.search.certificate(found.best.loop, max(found.best.m - 1, 1))
    return found._replace(certificate=certificate)


DESIGNS = Kind(
    "design", lambda rng: Case((_random_events if rng.random() < 0.1 else _random_periodic)(rng)),
    _certified, _simulate,
    {
        "one rung further": _broken(_one_rung_further, _random_periodic),
        "the gain of the given loop": _broken(_given_gain, _random_periodic),
        "no cost of inputs": _broken(_no_cost_of_inputs, _random_periodic),
        "one loss less, with events": _broken(_one_loss_less, partial(_random_events, **FAR)),
    },
)  # fmt: skip
