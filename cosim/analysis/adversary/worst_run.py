"""The worst run that the adversary found, compared with a certificate; as a table and as JSON."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from cosim.analysis.adversary.objective import Measure, Objective
from cosim.analysis.adversary.search_nodes import Pattern
from cosim.analysis.adversary.segments import Valued
from noack.config.scenario import Scenario
from noack.core.number_format import number
from noack.impairments.loss_guarantee import outcome_letters
from noack.theory.bounds.terms import Constants
from noack.theory.certificates.certified_bounds import ScenarioCertificate

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

    def to_json(self) -> dict[str, Any]:
        """Return all fields for JSON; an infinite value becomes null."""
        found = asdict(self) | {
            "objective": self.objective.value,
            "pattern": self.text,
            "delivered": [event for event, delivered in enumerate(self.pattern) if delivered],
            "tightness": self.tightness,
            "breaches": self.breaches,
            "diverges": self.diverges,
        }
        return {key: None if value == math.inf else value for key, value in found.items()}


def reported(value: float, objective: Objective) -> float | None:
    """Return the reported quantity of an objective's value."""
    if objective is not Objective.INTER_EVENT:
        return value
    return None if value == -math.inf else -value


def certified_value(
    certificate: ScenarioCertificate, measure: Measure, horizon_s: float, valued: Valued
) -> float | None:
    """Return the certificate's bound on the same quantity at the same time."""
    first, late = certificate.constants, certificate.floor_constants
    if first is None:
        return None
    if measure.objective is Objective.INTER_EVENT:
        return certificate.inter_event_s
    if measure.objective is Objective.COST:
        until_s = min(horizon_s, certificate.floor_from_s) if late is not None else horizon_s
        cost = _square_integral(first, until_s)
        return cost if late is None else cost + late.state**2 * (horizon_s - until_s)
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
    found: Sequence[Worst], resolved: Scenario, certificate: ScenarioCertificate, trigger: str
) -> dict[str, Any]:
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
        "worst": {worst.objective.value: worst.to_json() for worst in found},
    }


def print_worst(
    console: Console, found: Sequence[Worst], resolved: Scenario,
    certificate: ScenarioCertificate, trigger: str,
) -> None:  # fmt: skip
    """Print the results and their loss patterns."""
    table = Table(
        title=f"{resolved.name}: worst losses found, {resolved.network.guarantee.meaning}, "
        f"{resolved.horizon_s:g} s"
    )
    for heading in ("", "no loss", "scenario's seed", "worst", "certified", "share of bound used"):
        table.add_column(heading, justify="right" if heading else "left")
    for worst in found:
        values = (worst.lossless, worst.own, worst.value, worst.certified)
        table.add_row(
            _quantity(worst.objective, certificate, trigger),
            *(number(value, 4) for value in values),
            "[bold red]exceeded[/]" if worst.breaches else number(worst.tightness, 4),
        )
    console.print(table)
    for worst in found:
        at = "" if worst.at_s is None else f"worst at {worst.at_s:.6f} s; "
        how = "all patterns searched" if worst.exact else "not all patterns searched"
        speed = (
            f"{worst.runs:,} runs; {worst.nodes:,} segments, "
            f"{worst.nodes / worst.elapsed_s:,.0f} per second"
        )
        console.print(f"{worst.objective.value}: {at}{how} ({speed})")
        console.print(f"  {worst.text}", soft_wrap=True, highlight=False)
    if trigger == "sampled" and _is_shaped(certificate):
        console.print("[dim]Scaled: multiplied by bound(0) / bound(t)[/]")
    if certificate.void is not None:
        console.print(f"[dim]Nothing is certified: {certificate.void}[/]")
    elif trigger == "sampled":
        console.print("[dim]certified: for the scenario's schedule, without lateness[/]")
    console.print("[dim]One letter per event: D delivered, L lost. --json prints their times[/]")


def _quantity(objective: Objective, certificate: ScenarioCertificate, trigger: str) -> str:
    if trigger == "sampled":
        return _sampled_quantity(objective, certificate)
    rate = certificate.alpha_per_s
    if certificate.constants is not None:
        rate = certificate.constants.rate_per_s
    symbol = "α" if rate == certificate.alpha_per_s else f"{rate:.3g}"
    growth = f" e^({symbol}t)" if rate else ""
    return {
        Objective.ERROR: f"Δ: ‖e_c‖{growth} / β",
        Objective.STATE: f"X: ‖x‖{growth}",
        Objective.COST: "∫ ‖x‖² dt",
        Objective.INTER_EVENT: "inter-event time, s",
    }[objective]


def _sampled_quantity(objective: Objective, certificate: ScenarioCertificate) -> str:
    constants, scaled = certificate.constants, ""
    if _is_shaped(certificate):
        scaled = ", scaled"
    elif constants is not None and constants.rate_per_s:
        scaled = f" e^({constants.rate_per_s:.3g}t)"
    return {
        Objective.ERROR: f"‖e_c‖{scaled}",
        Objective.STATE: f"‖x‖{scaled}",
        Objective.COST: "∫ ‖x‖² dt",
        Objective.INTER_EVENT: "inter-event time, s",
    }[objective]


def _is_shaped(certificate: ScenarioCertificate) -> bool:
    """Return whether the bounds are not c e^{−rt}."""
    parts = (certificate.persistent_constants, certificate.floor_constants, certificate.other)
    return any(part is not None for part in parts)
