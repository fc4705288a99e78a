"""The worst run that the adversary found: with the worst disturbances, and as a table and as JSON.

With given events the loop is linear, so the vector whose norm is largest is the sum of the
responses to each value of a disturbance. Every value is set to its bound, with the sign of its
response in the direction of that vector. The events move then, so the caller runs the loop again.
Only bounds at all times are used: ``uniform`` disturbances and ``noise_bound``. Other kinds stay as
they are drawn.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from cosim.analysis.adversary.loop_flows import Measure, Objective, Pattern, SampledFlow, SampledRun, Valued
from cosim.simulation.sampled_loop import (
    Numbers,
    Runs,
    SampledLoop,
    Scales,
    disturbance_effect,
    noise_of,
    state_increments,
)
from noack.core.linear_systems import Matrix, Vector
from noack.core.number_format import at_least, at_most, number
from noack.disturbances.uniform import UniformDisturbance
from noack.impairments.loss_guarantee import outcome_letters
from noack.scenario.scenario import Scenario
from noack.theory.bounds.certificate_terms import Constants
from noack.theory.certificates.certified_bounds import ScenarioCertificate

_MOST_RESPONSES = 2000
"""With more values than this, successive ones have the same sign."""


class Bounds(NamedTuple):
    """What the values of disturbances and noise may be."""

    columns: Matrix
    """Change of x by each disturbance at its bound, (n, d)."""
    noise: Vector
    """Bound of each entry of v, (p,)."""


def bounds_of(resolved: Scenario) -> Bounds | None:
    """Return the bounds of a scenario; None if nothing has a bound at all times."""
    effect, columns = disturbance_effect(resolved), []
    m = resolved.model.dimensions[1]
    for disturbance in resolved.plant.disturbances:
        if isinstance(disturbance, UniformDisturbance):
            entry_matrix = effect[:, :m] if disturbance.at == "input" else effect[:, m:]
            columns.append(entry_matrix @ disturbance.extent())
    noise = np.array(resolved.plant.measurement.noise_bound or ())
    changes = np.hstack([np.zeros((len(effect), 0)), *columns])
    changes = changes[:, changes.any(axis=0)]
    return Bounds(changes, noise) if changes.size or noise.any() else None


def worst_disturbances(
    flow: SampledFlow, bounds: Bounds, run: SampledRun, at_s: float
) -> Iterator[SampledLoop]:
    """Yield loops whose disturbances and noise are worst at a time, for the events of a run.

    The norm is largest in some direction: each loop maximises one entry of the vector, with either
    sign, or its part in the direction that it has without the change.
    """
    loop, step = flow.loop, round(at_s / flow.loop.step_s)
    start = loop.start()
    _follow_events(loop, start, start.step.copy(), run, step, 0 if loop.known_start else 1)
    fixed, drawn = _fixed_disturbances(loop), loop.disturbances
    n, k, j = loop.matrices.n, step, step // loop.every + 1
    linear = loop.with_disturbances(np.zeros((0, n)), np.zeros((0, drawn[1].shape[1])))
    responses = [_responses_to_disturbance(linear, flow, column, run, step) for column in bounds.columns.T]
    noises = [
        _responses_to_noise(linear, flow, entry, bound, run, step) for entry, bound in enumerate(bounds.noise)
    ]
    axes = np.eye(n)
    for direction in (_vectors(flow, start)[0], *axes, *-axes):
        disturbed, noise = fixed[0].copy(), fixed[1].copy()
        for column, response in zip(bounds.columns.T, responses, strict=True):
            disturbed[:k] += np.sign(response @ direction)[:, None] * column
        for entry, response in enumerate(noises):
            noise[:j, entry] += bounds.noise[entry] * np.sign(response @ direction)
        disturbed[k:], noise[j:] = drawn[0][k:], drawn[1][j:]
        yield loop.with_disturbances(disturbed, noise)


def _responses_to_disturbance(
    linear: SampledLoop, flow: SampledFlow, column: Vector, run: SampledRun, step: int
) -> Matrix:
    """Return what the disturbance of each step before ``step`` adds to the vector, (step, n)."""
    steps = _some(np.arange(1, step + 1))
    runs = linear.empty(len(steps))
    runs.x[:], runs.step[:] = column, steps
    linear.measure_at(runs)
    _follow_events(linear, runs, steps, run, step, 0)
    return np.repeat(_vectors(flow, runs), np.diff(steps, append=step + 1), axis=0)


def _responses_to_noise(
    linear: SampledLoop, flow: SampledFlow, entry: int, bound: float, run: SampledRun, step: int
) -> Matrix:
    """Return what the noise of each measurement up to ``step`` adds to the vector, (k, n)."""
    last = step // linear.every
    numbers = _some(np.arange(last + 1))
    runs = linear.empty(len(numbers))
    runs.step[:] = numbers * linear.every
    runs.y[:] = bound * linear.correction(numbers)[:, :, entry]
    _follow_events(linear, runs, runs.step.copy(), run, step, 0)
    return np.repeat(_vectors(flow, runs), np.diff(numbers, append=last + 1), axis=0)


def _fixed_disturbances(loop: SampledLoop) -> tuple[Matrix, Matrix]:
    """Return disturbances and noise without their bounded parts."""
    plant, zeros = loop.resolved.plant, np.zeros_like
    disturbances = tuple(
        disturbance.model_copy(update={"bound": tuple(zeros(disturbance.bound).tolist())})
        if isinstance(disturbance, UniformDisturbance)
        else disturbance
        for disturbance in plant.disturbances
    )
    measurement = plant.measurement
    if measurement.noise_bound is not None:
        silent = tuple(zeros(measurement.noise_bound).tolist())
        measurement = measurement.model_copy(update={"noise_bound": silent})
    changed = {"disturbances": disturbances, "measurement": measurement}
    fixed = loop.resolved.model_copy(update={"plant": plant.model_copy(update=changed)})
    increments, noise = state_increments(fixed), noise_of(fixed)
    return increments, noise if len(noise) else np.zeros_like(loop.disturbances[1])


def _follow_events(
    loop: SampledLoop, runs: Runs, begin: Numbers, run: SampledRun, last_step: int, first_event: int
) -> None:
    """Advance runs that begin at ascending steps to ``last_step``, with the events of a run."""
    ones = np.ones(loop.last + 1)
    scales = Scales(loop.weight, ones, ones)
    steps = np.rint(np.array(run.event_s) / loop.step_s).astype(np.int64)
    for event, arrives in list(zip(steps.tolist(), run.delivered, strict=True))[first_event:]:
        if event >= last_step:
            break
        count = int(np.searchsorted(begin, event, side="right"))
        parts: list[Any] = [part[:count] for part in runs]
        running = Runs(*parts)
        loop.follow(running, scales, np.full(count, event), tests=False)
        loop.update(running, np.full(count, arrives))
    loop.follow(runs, scales, np.full(len(begin), last_step), tests=False)


def _vectors(flow: SampledFlow, runs: Runs) -> Matrix:
    """Return the vectors whose norm is the objective, (N, n)."""
    if flow.objective is Objective.STATE:
        return runs.x
    return np.asarray((runs.x_c - runs.y) @ flow.loop.weight.T)


def _some(numbers: Numbers) -> Numbers:
    """Return every k-th number, so that there are not too many responses."""
    return numbers[:: max(len(numbers) // _MOST_RESPONSES, 1)]


_BREACH = 1 + 1e-9


@dataclass(frozen=True)
class Worst:
    """The worst run found, for one objective.

    In continuous time the values are Δ, X, ∫‖x‖² dt, and seconds between two events. In the
    sampled loop Δ is not divided by β, and the bounds may have any shape instead of e^{−rt}.
    """

    objective: Objective
    horizon_s: float
    value: float | None
    """Infinite if the loop diverges; None if there is no inter-event time above 0."""
    at_s: float | None
    """Time of the supremum, or of the later of the two closest events."""
    pattern: Pattern
    """Whether the update of each event is delivered."""
    event_s: tuple[float, ...]
    """Times of the events."""
    exact: bool
    """Whether every admissible pattern was covered; otherwise others may be worse."""
    nodes: int
    """Segments between events that were computed."""
    runs: int
    """Runs up to the horizon; if every pattern was covered, those of this search alone."""
    lossless: float | None
    """The value without losses."""
    own: float | None
    """The value with the losses of the scenario's own network."""
    certified: float | None
    """The certificate's bound; None without a certificate."""
    elapsed_s: float = field(compare=False)
    """Wall time of the search."""

    @property
    def tightness(self) -> float | None:
        """Found / certified value, or certified / found for inter-event times: at most 1."""
        if not self.value or not self.certified:
            return None
        if self.objective is Objective.INTER_EVENT:
            return self.certified / self.value
        return self.value / self.certified

    @property
    def breaches(self) -> bool:
        """Whether this run refutes the certificate."""
        return self.tightness is not None and self.tightness > _BREACH

    @property
    def diverges(self) -> bool:
        """Whether the loop diverges under the pattern."""
        return self.value == math.inf

    @property
    def text(self) -> str:
        """The pattern, one letter per event: ``D`` delivered, ``L`` lost."""
        return outcome_letters(self.pattern)

    def to_json(self) -> dict[str, object]:
        """Return all fields for JSON; an infinite value becomes null."""
        document = asdict(self) | {
            "objective": self.objective.value,
            "pattern": self.text,
            "delivered": [event for event, delivered in enumerate(self.pattern) if delivered],
            "tightness": self.tightness,
            "breaches": self.breaches,
            "diverges": self.diverges,
        }
        return {key: None if value == math.inf else value for key, value in document.items()}


def reported(value: float, objective: Objective) -> float | None:
    """Return the reported quantity of an objective's value."""
    if objective is not Objective.INTER_EVENT:
        return value
    return None if value == -math.inf else -value


def certified_value(
    certificate: ScenarioCertificate, measure: Measure, horizon_s: float, valued: Valued
) -> float | None:
    """Return the certificate's bound on the same quantity at the same time."""
    constants, floor = certificate.constants, certificate.floor_constants
    if constants is None:
        return None
    if measure.objective is Objective.INTER_EVENT:
        return certificate.inter_event_s
    if measure.objective is Objective.COST:
        until_s = min(horizon_s, certificate.floor_from_s) if floor is not None else horizon_s
        cost = _square_integral(constants, until_s)
        return cost if floor is None else cost + floor.state**2 * (horizon_s - until_s)
    at_s = np.array([valued.at_s or 0.0])
    level = float(measure.level(at_s)[0])
    if measure.objective is Objective.STATE:
        return float(certificate.state(at_s)[0]) / level
    return float(certificate.controller_error(at_s)[0]) / (level * measure.beta)


def _square_integral(constants: Constants, until_s: float) -> float:
    """Return ∫(X e^{−rt})² dt up to ``until_s``."""
    rate = 2 * constants.rate_per_s
    return constants.state**2 * (-math.expm1(-rate * until_s) / rate if rate else until_s)


def document(
    results: Sequence[Worst], resolved: Scenario, certificate: ScenarioCertificate, trigger: str
) -> dict[str, object]:
    """Return the results as JSON."""
    return {
        "scenario": resolved.name,
        "mode": resolved.mode,
        "policy": resolved.trigger.policy,
        "trigger": trigger,
        "mansd": resolved.network.mansd,
        "guarantee": resolved.network.guarantee.meaning,
        "horizon_s": resolved.horizon_s,
        "certificate": certificate.to_json(),
        "worst": {worst.objective.value: worst.to_json() for worst in results},
    }


def print_worst(
    console: Console,
    results: Sequence[Worst],
    resolved: Scenario,
    certificate: ScenarioCertificate,
    trigger: str,
) -> None:
    """Print the results and their loss patterns."""
    table = Table(
        title=f"{resolved.name}: worst losses found, {resolved.network.guarantee.meaning}, "
        f"{resolved.horizon_s:g} s"
    )
    for heading in ("", "no loss", "scenario's seed", "worst", "certified", "share of bound used"):
        table.add_column(heading, justify="right" if heading else "left")
    for worst in results:
        is_lower = worst.objective is Objective.INTER_EVENT
        certified = at_least(worst.certified) if is_lower else at_most(worst.certified)
        table.add_row(
            _quantity(worst.objective, certificate, trigger),
            *(number(value, 4) for value in (worst.lossless, worst.own, worst.value)),
            certified,
            "[bold red]exceeded[/]" if worst.breaches else number(worst.tightness, 4),
        )
    console.print(table)
    for worst in results:
        time_text = "" if worst.at_s is None else f"worst at {worst.at_s:.6f} s; "
        coverage = "all patterns searched" if worst.exact else "not all patterns searched"
        speed = (
            f"{worst.runs:,} runs; {worst.nodes:,} segments, {worst.nodes / worst.elapsed_s:,.0f} per second"
        )
        console.print(f"{worst.objective.value}: {time_text}{coverage} ({speed})")
        console.print(f"  {worst.text}", soft_wrap=True, highlight=False)
    if trigger == "sampled" and _is_shaped(certificate):
        console.print("[dim]Scaled: multiplied by bound(0) / bound(t)[/]")
    if certificate.void is not None:
        console.print(f"[dim]Nothing is certified: {certificate.void}[/]")
    elif trigger == "sampled":
        console.print("[dim]certified: for the scenario's schedule, without lateness[/]")
    console.print("[dim]One letter per event: D delivered, L lost. --json prints their times[/]")


def _quantity(objective: Objective, certificate: ScenarioCertificate, trigger: str) -> str:
    constants, sampled = certificate.constants, trigger == "sampled"
    alpha = certificate.alpha_per_s
    rate = (0.0 if sampled else alpha) if constants is None else constants.rate_per_s
    symbol = "α" if rate == alpha and not sampled else f"{rate:.3g}"
    growth = f" e^({symbol}t)" if rate else ""
    if sampled and _is_shaped(certificate):
        growth = ", scaled"
    error = "‖W e_c‖" if certificate.weighted else "‖e_c‖"
    return {
        Objective.ERROR: f"{error}{growth}" if sampled else f"Δ: {error}{growth} / β",
        Objective.STATE: f"‖x‖{growth}" if sampled else f"X: ‖x‖{growth}",
        Objective.COST: "∫ ‖x‖² dt",
        Objective.INTER_EVENT: "inter-event time, s",
    }[objective]


def _is_shaped(certificate: ScenarioCertificate) -> bool:
    """Return whether the bounds are not c e^{−rt}."""
    others = (certificate.persistent_constants, certificate.floor_constants, certificate.other)
    return any(other is not None for other in others)
