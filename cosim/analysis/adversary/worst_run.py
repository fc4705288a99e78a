"""The worst run that the adversary found, as values, as a table and as JSON."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cosim.analysis.adversary.loop_flows import Objective, Pattern
from cosim.analysis.adversary.worst_disturbances import disturbance_bounds
from noack.core.clock import NS_PER_S
from noack.core.number_format import NONE, at_least, at_most, duration, number
from noack.guarantee.loss_guarantee import outcome_letters
from noack.scenario.scenario import Scenario
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import network_delay_ns

BREACH = 1 + 1e-9
"""Share of the bound from which on a run refutes it; below are rounding errors."""


@dataclass(frozen=True)
class WorstRun:
    """The worst run found, for one objective.

    The values are sup ‖W e_c‖ and sup ‖x‖, both scaled by the shape of their bounds, ∫‖x‖² dt, and
    seconds between two events.
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
    """Whether every admissible pattern was covered, or this one diverges; else others may be worse."""
    nodes: int
    """Segments between events that were computed."""
    runs: int
    """Runs up to the horizon; if every pattern was covered, those of this search alone."""
    lossless: float | None
    """The value without losses."""
    with_own_network: float | None
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
        return self.tightness is not None and self.tightness > BREACH

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


def reported_value(value: float, objective: Objective) -> float | None:
    """Return an objective's value as it is reported: an inter-event time has its sign reversed."""
    if objective is not Objective.INTER_EVENT:
        return value
    return None if value == -math.inf else -value


def document(
    results: Sequence[WorstRun],
    resolved: Scenario,
    certificate: ScenarioCertificate,
    shares: Mapping[str, float],
) -> dict[str, object]:
    """Return the results as JSON; ``shares`` are those of their bounds that outputs have, by their names."""
    return {
        "scenario": resolved.name,
        "mode": resolved.mode,
        "policy": resolved.trigger.policy,
        "trigger": "sampled",
        "mansd": resolved.network.mansd,
        "guarantee": resolved.network.guarantee.meaning,
        "horizon_s": resolved.horizon_s,
        "certificate": certificate.to_json(),
        "worst": {worst.objective.value: worst.to_json() for worst in results},
        "outputs": {name: {"tightness": share} for name, share in shares.items()},
    }


def print_worst(
    console: Console,
    results: Sequence[WorstRun],
    resolved: Scenario,
    certificate: ScenarioCertificate,
    shares: Mapping[str, float],
) -> None:
    """Print the results and their loss patterns, and the shares of their bounds that outputs have."""
    table = Table(
        title=f"{resolved.name}: worst losses found, {resolved.network.guarantee.meaning}, "
        f"{resolved.horizon_s:g} s"
    )
    for heading in ("", "no loss", "scenario's seed", "worst", "certified", "share used"):
        table.add_column(heading, justify="right" if heading else "left")
    for worst in results:
        is_lower = worst.objective is Objective.INTER_EVENT
        certified = at_least(worst.certified) if is_lower else at_most(worst.certified)
        table.add_row(
            _quantity(worst.objective, certificate, weighted=resolved.trigger.weight is not None),
            *(number(value, 4) for value in (worst.lossless, worst.with_own_network, worst.value)),
            certified,
            "[bold red]exceeded[/]" if worst.breaches else _share_used(worst.tightness),
        )
    console.print(table)
    for name, share in shares.items():
        console.print(f"{escape(name)}: {_share_used(share)} of its bound was reached")
    for worst in results:
        time_text = "" if worst.at_s is None else f"worst at {worst.at_s:.6f} s; "
        coverage = "all patterns searched" if worst.exact else "not all patterns searched"
        speed = (
            f"{worst.runs:,} runs; {worst.nodes:,} segments, {worst.nodes / worst.elapsed_s:,.0f} per second"
        )
        outcome = "the loop diverges" if worst.diverges else f"{time_text}{coverage} ({speed})"
        console.print(f"{worst.objective.value}: {outcome}")
        console.print(f"  {worst.text}", soft_wrap=True, highlight=False)
    for note in _notes(resolved):
        console.print(note)
    if any(worst.tightness is not None for worst in results):
        console.print("[dim]share used: of the certified bound, by the worst losses[/]")
    if _is_shaped(certificate):
        console.print("[dim]Scaled: multiplied by bound(0) / bound(t)[/]")
    if certificate.void is not None and not certificate.exists:
        console.print(f"[dim]Nothing is certified: {escape(certificate.void)}[/]")
    else:
        console.print("[dim]certified: proved for the scenario's schedule[/]")
    console.print("[dim]One letter per event: D delivered, L lost. --json prints their times[/]")


def _share_used(share: float | None) -> str:
    return NONE if share is None else f"{100 * share:.4g} %"


def _notes(resolved: Scenario) -> Iterator[str]:
    """Yield what the values assume besides the losses."""
    if not resolved.network.enforce_mansd:
        yield "[yellow]Nothing enforces this limit of the losses: the network may lose more[/]"
    if not resolved.coverage.is_undisturbed:
        yield "[dim]Disturbances and noise are drawn from the seeds[/]"
        if disturbance_bounds(resolved) is not None:
            yield "[dim]The worst error and state are for the worst signs of bounded ones that were found[/]"
    if delay_ns := network_delay_ns(resolved, 0):
        longest = duration(delay_ns / NS_PER_S)
        yield f"[dim]Every delivered update takes the longest delay that is certified, {longest}[/]"


def _quantity(objective: Objective, certificate: ScenarioCertificate, *, weighted: bool) -> str:
    rate = 0.0 if certificate.proven is None else certificate.proven.rate_per_s
    growth = f" e^({rate:.3g}t)" if rate else ""
    if _is_shaped(certificate):
        growth = ", scaled"
    error = "‖W e_c‖" if weighted else "‖e_c‖"
    return {
        Objective.ERROR: f"{error}{growth}",
        Objective.STATE: f"‖x‖{growth}",
        Objective.COST: "∫ ‖x‖² dt",
        Objective.INTER_EVENT: "inter-event time, s",
    }[objective]


def _is_shaped(certificate: ScenarioCertificate) -> bool:
    """Return whether the bounds are not c e^{−rt}."""
    return certificate.proven is not None and any(
        bound.decaying and bound.constant for bound in certificate.proven.bounds.values()
    )
