"""The search for a gain and a threshold whose certificate exists for the largest M.

The sensor has the paper's trigger. *Certified for M* means: under the scenario's schedule, for all
plants of its uncertainty box, there is a certificate with at most M − 1 consecutive losses. If the
given loop has none for the box even with M = 1, the scenario's own plant is certified instead.

Q, R and the number of transmissions are measured over common draws of the scenario's own network,
in continuous time. Regulators (LQR) over a grid of weights are the starts; then K, α and β are
searched together without gradients (Nelder and Mead). The result is measured on fresh draws.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from cosim.output.figures.figure_description import Axis, FigureDescription, Line, Panel
from cosim.output.figures.palette import LOST, NETWORK
from cosim.simulation.exact_simulation import Population, run_batch, setting_of
from cosim.studies.campaign.random_draws import box_of
from cosim.studies.design.design_outcome import (
    DesignOutcome,
    LoopResult,
    figure_of,
    gain_text,
    periodic_outcome,
)
from cosim.studies.design.design_search import WORDS, bounds_of
from cosim.studies.design.design_space import lqr_gain, round_gain
from cosim.studies.design.network_search import (
    COSTS_OF_INPUT,
    DesignRequest,
    NetworkSearch,
    Progress,
    examined_m,
)
from cosim.studies.design.simplex_search import nelder_mead, step_sizes
from noack.core.errors import CallerError
from noack.core.linear_systems import Vector, spectral_abscissa
from noack.core.number_format import NONE, at_most, to_digits
from noack.scenario.resolution import loop_of, resolve
from noack.scenario.scenario import Scenario
from noack.settings.section import MatrixRows, rows_of
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import nominal_conditions
from noack.theory.certificates.scenario_certificates import certify, certify_box, outside_box
from noack.trigger_policies.decaying import DecayingSettings

DRAWS = 200
"""Draws of which the mean cost is estimated."""
_ALPHAS = (1.0, 0.5)
"""Factors of α of the starts."""
_STARTS = 3
"""Best candidates from which the search descends."""
_FORBIDDEN = 1e3
"""Objective of a loop that may not be chosen; those of others are smaller."""
_LARGEST_LOG_BOUND = 50.0
"""Larger logarithms of a bound of the state are not distinguished."""
_MOST_M = 1000
"""Largest M that is examined by default."""


class EventLoop(NamedTuple):
    """A gain and a threshold."""

    K: MatrixRows
    alpha_per_s: float
    beta: float


class MeanCosts(NamedTuple):
    """Means over draws; infinite if a run diverges."""

    cost: float
    transmissions: float


class CertifiedEventLoop(NamedTuple):
    """A loop with the largest M for which it has a certificate."""

    loop: EventLoop
    m: int
    """0: there is none."""
    measured: MeanCosts
    """On fresh draws."""


class EventSearch:
    """All that is known about the loops of a scenario with other gains and thresholds."""

    def __init__(self, scenario: Scenario, request: DesignRequest, seed: int, draws: int = DRAWS) -> None:
        trigger = scenario.decaying
        scenario.coverage.require_exact()
        scenario.coverage.require_unchanging()
        if not request.cost > 0:
            raise CallerError(f"--cost: must be positive, not {request.cost:g}")
        if request.holds is not None:
            raise CallerError("--holds: is for periodic updates; give their --period, too")
        if request.window is not None:
            raise CallerError("--window: is for periodic updates; give their --period, too")
        resolved = resolve(scenario)
        self.scenario, self.request, self.plant = scenario, request, loop_of(resolved)
        n, m = self.plant.n, self.plant.m
        self.weights = request.weights or (np.eye(n), np.eye(m))
        lqr_gain(self.plant.A_model, self.plant.B_model, *self.weights)  # raises if there is none
        self.original = EventLoop(rows_of(self.plant.K), trigger.alpha_per_s, trigger.beta)
        self.tried = self.examined = self._likely = 0
        self.most = examined_m(scenario, request.most or _MOST_M)
        box = box_of(scenario)
        self._draws = box.population(seed, range(draws))
        self._fresh_draws = box.population(seed, range(draws, 2 * draws))
        self.of_box = False
        certificate = self.certificate(self.original, 1, of_box=True)
        is_certified = certificate is not None and certificate.exists
        self.of_box = is_certified and outside_box(resolved) is None
        base = self.measure(self.original, self._draws)
        if base.cost == 0:
            raise CallerError(
                "the given loop costs 0, so that --cost limits nothing; give another plant.initial_state"
            )
        self.limits = MeanCosts(request.cost * base.cost, request.transmissions * base.transmissions)

    def scenario_of(self, loop: EventLoop, m: int | None = None) -> Scenario:
        """Return the scenario of a loop; with M, or with its own."""
        scenario = self.scenario
        trigger = scenario.decaying.model_copy(update={"alpha_per_s": loop.alpha_per_s, "beta": loop.beta})
        update: dict[str, object] = {
            "model": scenario.model.model_copy(update={"gain": loop.K}),
            "trigger": trigger,
        }
        if m is not None:
            update["network"] = scenario.network.model_copy(update={"mansd": m - 1})
        return scenario.model_copy(update=update)

    def certificate(
        self, loop: EventLoop, m: int, *, of_box: bool | None = None
    ) -> ScenarioCertificate | None:
        """Return the certificate for M under the scenario's schedule."""
        self.examined += 1
        resolved = resolve(self.scenario_of(loop, m))
        conditions = nominal_conditions(resolved, resolved.certificate.late_periods)
        if self.of_box if of_box is None else of_box:
            return certify_box(resolved, conditions)
        return certify(resolved, conditions)

    def state_bound(self, loop: EventLoop, m: int) -> float:
        """Return certified sup‖x‖; infinite without a certificate, or beyond the given limits."""
        certificate = self.certificate(loop, m)
        if certificate is None:
            return math.inf
        bounds = bounds_of(certificate, self.scenario)
        within = all(bounds[name] <= limit for name, limit in self.request.bounds.items())
        return bounds["state"] if within else math.inf

    def measure(self, loop: EventLoop, population: Population) -> MeanCosts:
        """Run a loop over draws; one whose model does not decay may have too many events to run."""
        if not self._decay_per_s(loop) > 0:
            return MeanCosts(math.inf, math.inf)
        Q, R = self.weights
        setting = replace(setting_of(resolve(self.scenario_of(loop))), Q=Q, R=R)
        rows = run_batch(setting, population)
        if np.isnan(rows["cost"]).any():
            return MeanCosts(math.inf, math.inf)
        return MeanCosts(float(rows["cost"].mean()), float(rows["transmissions"].mean()))

    def _decay_per_s(self, loop: EventLoop) -> float:
        """Return the decay rate of the model's closed loop."""
        return -spectral_abscissa(self.plant.A_model + self.plant.B_model @ np.array(loop.K))

    def largest_m(self, loop: EventLoop) -> int:
        """Return the largest M with a certificate, by bisection; 0: there is none.

        The bounds grow with M, so that it ceases to exist at one M. Only this M is claimed.
        """
        low, high = 0, max(self._likely * 2 // 3, 1)
        while high <= self.most and math.isfinite(self.state_bound(loop, high)):
            low, high = high, max(high * 4 // 3, high + 1)
        high = min(high, self.most + 1)
        while high - low > 1:
            middle = (low + high) // 2
            if math.isfinite(self.state_bound(loop, middle)):
                low = middle
            else:
                high = middle
        self._likely = low
        return low

    def excess(self, loop: EventLoop) -> float:
        """Return what is minimised: below 0 if all limits are met, the lower the better."""
        decay_per_s = self._decay_per_s(loop)
        if not 0 < loop.alpha_per_s < decay_per_s:
            return _FORBIDDEN + min(abs(decay_per_s), _FORBIDDEN)
        self.tried += 1
        measured, least = self.measure(loop, self._draws), self.scenario.network.mansd + 1
        over = _log_over(measured.cost, self.limits.cost)
        if self.request.goal == "transmissions":
            bound = 0.0 if math.isfinite(self.state_bound(loop, least)) else 1.0
            if over or bound:
                return min(1.0 + over + bound, _FORBIDDEN)
            return math.log(measured.transmissions / 1e6)  # below 0: no run has a million
        over += _log_over(measured.transmissions, self.limits.transmissions)
        if over:
            return min(1.0 + over, _FORBIDDEN)
        m = self.largest_m(loop)
        # Between loops of the same M, a smaller bound is closer to the next M.
        bound = min(math.log1p(self.state_bound(loop, m)), _LARGEST_LOG_BOUND) if m else _LARGEST_LOG_BOUND
        return -math.log1p(m) - 0.01 * (1 - bound / _LARGEST_LOG_BOUND)

    def run(self, progress: Progress = lambda share: None) -> tuple[CertifiedEventLoop, CertifiedEventLoop]:
        """Return the given loop and the best one found."""
        plant, (Q, R) = self.plant, self.weights
        starts = [self.original]
        for factor in COSTS_OF_INPUT:
            K = lqr_gain(plant.A_model, plant.B_model, Q, factor * R).ravel()
            for scale in _ALPHAS:
                alpha_per_s = scale * self.original.alpha_per_s
                starts.append(_rounded(K, self.original, alpha_per_s, self.original.beta))
        values = []
        for number, start in enumerate(starts):
            values.append(self.excess(start))
            progress(0.3 * (number + 1) / len(starts))
        order = sorted(range(len(starts)), key=lambda number: values[number])[:_STARTS]
        best, value = starts[order[0]], values[order[0]]
        for number, index in enumerate(order):

            def report_share(share: float, number: int = number) -> None:
                progress(0.3 + 0.6 * (number + share) / len(order))

            tries = self.request.effort // (10 * _STARTS)
            candidate, candidate_value = self._improve(starts[index], tries, report_share)
            if candidate_value < value:
                best, value = candidate, candidate_value
            report_share(1.0)
        if value >= min(values[0], 0.0):  # no better than the given loop, or beyond a limit
            best = self.original
        original, designed = (
            CertifiedEventLoop(loop, self.largest_m(loop), self.measure(loop, self._fresh_draws))
            for loop in (self.original, best)
        )
        return original, designed

    def _improve(self, start: EventLoop, most_tries: int, progress: Progress) -> tuple[EventLoop, float]:
        centre = np.array([*np.ravel(start.K), start.alpha_per_s, start.beta])
        scale = np.append(step_sizes(np.array(start.K)), centre[-2:])
        best, value, tries = start, math.inf, 0

        def objective(steps: Vector) -> float:
            nonlocal best, value, tries
            tries += 1
            progress(min(tries / most_tries, 1.0))
            parameters = centre + scale * steps
            parameters[-2:] = centre[-2:] * np.exp(steps[-2:])
            loop = _rounded(parameters[:-2], start, *parameters[-2:].tolist())
            excess = self.excess(loop)
            if excess < value:
                best, value = loop, excess
            return excess

        if most_tries > 0:
            nelder_mead(objective, centre.size, 0.2, most_tries)
        return best, value


def _log_over(value: float, limit: float) -> float:
    """Return the logarithm of the factor by which a value exceeds its limit; 0 within it."""
    return math.log(value / limit) if value > limit else 0.0


def _rounded(entries: Vector, template: EventLoop, alpha_per_s: float, beta: float) -> EventLoop:
    """Return a loop with six digits: what is certified is what is printed."""
    K = round_gain(entries.reshape(-1, len(template.K[0])))
    return EventLoop(K, to_digits(alpha_per_s, 6), to_digits(beta, 6))


def event_outcome(
    search: EventSearch, original: CertifiedEventLoop, best: CertifiedEventLoop
) -> DesignOutcome:
    """Return what is shown of a search."""
    of_network = search.request.goal == "network"
    return DesignOutcome(
        name=search.scenario.name,
        claim="certified " + ("for the whole box" if search.of_box else "for the scenario's own plant"),
        given=_loop_result(search, original),
        best=_loop_result(search, best),
        notes=list(_notes(search, original, best)),
        scenario=search.scenario_of(best.loop, best.m if of_network and best.m else None),
        is_certified=best.m > 0,
        is_better=best.loop != original.loop,
        document={
            "goal": search.request.goal,
            "of_box": search.of_box,
            "limits": search.limits._asdict(),
            "tried": search.tried,
            "examined": search.examined,
        },
        figure=_figure(search, original, best),
    )


def _notes(search: EventSearch, original: CertifiedEventLoop, best: CertifiedEventLoop) -> Iterator[str]:
    """Yield what the reader should know of a search."""
    limits, alpha_per_s, best_alpha_per_s = search.limits, original.loop.alpha_per_s, best.loop.alpha_per_s
    limit = f"a mean cost of at most {limits.cost:.4g}"
    if search.request.goal == "network":
        limit += f", at most {limits.transmissions:.4g} transmissions"
    for name, bound in search.request.bounds.items():
        limit += f", {WORDS[name]} ≤ {bound:g} certified"
    proven = "its certificate is proven, that it is the best is not" if best.m else "it has no certificate"
    yield f"the best of {search.tried:,} loops tried with {limit}; {proven}"
    yield "costs and transmissions are means over fresh draws with the scenario's own network"
    if best_alpha_per_s < alpha_per_s:
        rates = f"{best_alpha_per_s:.4g} /s instead of {alpha_per_s:.4g} /s"
        yield f"the threshold and the certified bounds decay at {rates}"


def _loop_result(search: EventSearch, certified: CertifiedEventLoop) -> LoopResult:
    loop, m, measured = certified

    def bound(m: int) -> str:
        value = search.state_bound(loop, m) if m else math.inf
        return at_most(value) if value < math.inf else NONE

    reach = f"M = {m}{', the most examined' * (m == search.most)}" if m else "nothing certified"
    own_m = search.scenario.network.mansd + 1
    cells = {
        "certified for": reach,
        "sup‖x‖ for that M at most": bound(m),
        f"sup‖x‖ with M = {own_m} at most": bound(own_m),
        "cost, mean": f"{measured.cost:.4g}",
        "transmissions, mean": f"{measured.transmissions:.4g}",
        "α [1/s]": f"{loop.alpha_per_s:.4g}",
        "β": f"{loop.beta:.4g}",
        "K": gain_text(loop.K),
    }
    return LoopResult(reach, cells, {"certified": m or None, **loop._asdict(), **measured._asdict()})


def _figure(search: EventSearch, original: CertifiedEventLoop, best: CertifiedEventLoop) -> FigureDescription:
    """Describe the certified bounds of ‖x‖ over M, which end where the certificate does."""
    numbers = np.unique(np.geomspace(1, max(original.m, best.m, 2), 30).round().astype(int))
    items = []
    for certified, label, colour in ((original, "given", NETWORK), (best, "designed", LOST)):
        bounds = np.array([search.state_bound(certified.loop, int(m)) for m in numbers])
        items.append(Line(x=numbers.astype(float), y=bounds, colour=colour, label=label, marker="o"))
    x, y = Axis(label="M", logarithmic=True), Axis(label="certified sup‖x‖", logarithmic=True)
    caption = "Certified bound of the state over M. A curve ends where its certificate does."
    return figure_of("certified", Panel(items=items, x=x, y=y), caption)


def design_for_network(
    scenario: Scenario, request: DesignRequest, seed: int = 0, progress: Progress = lambda share: None
) -> DesignOutcome:
    """Search for a loop; with a period it is time-triggered. The result is deterministic.

    Raises:
        CallerError: the scenario does not permit it, or a request is out of range.
    """
    if request.period_s is None and isinstance(scenario.trigger, DecayingSettings):
        events = EventSearch(scenario, request, seed)
        return event_outcome(events, *events.run(progress))
    search = NetworkSearch(scenario, request)
    return periodic_outcome(search, *search.run(progress))
