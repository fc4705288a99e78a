"""The certificates of a scenario, as tables and as JSON."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cosim.output.assumptions_table import print_assumptions
from noack.config.resolution import loop_of, resolve
from noack.config.scenario import Scenario
from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix
from noack.core.number_format import duration, number
from noack.theory.assumptions import assumptions
from noack.theory.certificate import NetworkConditions
from noack.theory.enclosure import NotDecayingError
from noack.theory.paper_bounds import Theorem2, theorem_2
from noack.theory.run_conditions import ideal_conditions, nominal_conditions
from noack.theory.scenario_certificates import (
    BOX,
    CertificateScope,
    ScenarioCertificate,
    box,
    outside_box,
    own_plant,
)
from noack.theory.weight import choose_weight

IDEAL = "paper"
"""The paper's conditions: no sampling, no delay, no hold."""
SCHEDULE = "schedule"
"""The scenario's rates, and the lateness that it allows."""

MOST_LATE = 1000
_MOST_S = 10.0


class NetworkLimits(NamedTuple):
    """Largest certified value of each quantity; the others are those of the schedule."""

    sampling_s: float
    delay_s: float
    hold_s: float


@dataclass(frozen=True)
class Study:
    """All certificates of a scenario.

    Args:
        resolved: the resolved scenario.
        certificates: under the paper's conditions and under the schedule's.
        scopes: the plants that they cover.
        scheduled: the schedule's conditions.
        theorem_2: the paper's bounds, with Δ from the ideal certificate.
        weight: W, if noack chose it.
    """

    resolved: Scenario
    certificates: Sequence[tuple[str, ScenarioCertificate]]
    scopes: Sequence[CertificateScope]
    scheduled: NetworkConditions
    theorem_2: Theorem2 | None
    weight: Matrix | None

    @cached_property
    def limits(self) -> dict[str, NetworkLimits]:
        """Limits by scope; computed at first use, from about a hundred certificates."""
        return {scope.name: _limits(scope, self.scheduled) for scope in self.scopes}

    def certificate(self, under: str) -> ScenarioCertificate:
        """The certificate of the scenario's own plant, under IDEAL or SCHEDULE."""
        return next(one for key, one in self.certificates if key == under)

    def box_certificate(self, under: str) -> ScenarioCertificate | None:
        """The certificate of the scenario's uncertainty box; None if it has none."""
        of_box = (one for key, one in self.certificates if key == under and one.scope == BOX)
        return next(of_box, None)

    def to_json(self) -> dict[str, Any]:
        """Return the study as one JSON document."""
        theorem = None if self.theorem_2 is None else self.theorem_2._asdict()
        return {
            "scenario": self.resolved.name,
            "weight": None if self.weight is None else self.weight.tolist(),
            "paper": {
                "assumptions": [a._asdict() for a in assumptions(self.resolved)],
                "theorem_2": theorem,
            },
            "certificates": [
                {"under": under, **certificate.to_json()}
                for under, certificate in self.certificates
            ],
            "limits": {scope: limits._asdict() for scope, limits in self.limits.items()},
        }


def with_weight(
    resolved: Scenario, which: str, progress: Callable[[float], None] = lambda share: None
) -> tuple[Scenario, Matrix | None]:
    """Return the scenario with the requested weight, and W if noack chose it.

    Raises:
        CallerError: the choice is unknown, or no weight can be chosen for this scenario.
    """
    weight: Matrix | None = None
    if which == "given":
        return resolved, None
    if which == "chosen":
        trigger = resolved.decaying
        try:
            weight = choose_weight(
                loop_of(resolved), trigger.beta, trigger.alpha_per_s, resolved.network.mansd,
                progress,
            )  # fmt: skip
        except NotDecayingError as error:
            raise CallerError(f"weight chosen: {error}") from None
    elif which != "identity":
        raise CallerError(f'weight: given, identity or chosen, not "{which}"')
    rows = None if weight is None else tuple(tuple(row) for row in weight.tolist())
    trigger = resolved.decaying.model_copy(update={"weight": rows})
    return resolved.model_copy(update={"trigger": trigger}), weight


def study_scenario(
    scenario: Scenario,
    weight: str = "given",
    late_periods: int | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> Study:
    """Certify a scenario as :func:`study` does, with a chosen norm and allowed lateness.

    Args:
        scenario: as loaded; it is resolved here.
        weight: ``given``, ``identity`` or ``chosen``.
        late_periods: allowed lateness in steps of the plant, 0 to 1000; by default the scenario's.
        progress: called with the completed share of the choice of a weight.

    Raises:
        CallerError: the choice is unknown, or no certificate covers this scenario.
    """
    resolved = resolve(scenario)
    allowed = resolved.certificate.late_periods if late_periods is None else late_periods
    if not 0 <= allowed <= MOST_LATE:
        raise CallerError(f"late: {allowed} steps; give 0 to {MOST_LATE}")
    weighted, W = with_weight(resolved, weight, progress)
    return study(weighted, allowed, W)


def study(resolved: Scenario, late_periods: int, weight: Matrix | None = None) -> Study:
    """Certify a scenario under the paper's conditions and under its own schedule.

    Raises:
        CallerError: its updates are acknowledged, its plant is nonlinear or disturbed, or its
            state is not measured exactly.
    """
    resolved.coverage.require_unchanging()
    resolved.coverage.require_exact()
    ideal, scheduled = ideal_conditions(resolved), nominal_conditions(resolved, late_periods)
    scopes = [scope for scope in (own_plant(resolved), box(resolved)) if scope is not None]
    certificates = [(IDEAL, scope.certificate(ideal)) for scope in scopes]
    certificates += [(SCHEDULE, scope.certificate(scheduled)) for scope in scopes]
    first = certificates[0][1].constants
    trigger = resolved.decaying
    theorem = (
        theorem_2(loop_of(resolved), trigger.beta, trigger.alpha_per_s, first.delta)
        if first is not None and first.rate_per_s == trigger.alpha_per_s and not trigger.floor
        and trigger.weight is None
        else None
    )  # fmt: skip
    return Study(resolved, certificates, scopes, scheduled, theorem, weight)


def _limits(scope: CertificateScope, scheduled: NetworkConditions) -> NetworkLimits:
    return NetworkLimits(
        scope.largest(
            scheduled, lambda c, value: c._replace(sampling_s=value, spacing_s=value), _MOST_S
        ),
        scope.largest(
            scheduled, lambda c, value: c._replace(delay_s=value, start_s=value), _MOST_S
        ),
        scope.largest(scheduled, lambda c, value: c._replace(hold_s=value), _MOST_S),
    )


def print_study(console: Console, found: Study) -> None:
    """Print the tables."""
    _print_constants(console, found)
    _print_limits(console, found)
    if (outside := outside_box(found.resolved)) is not None:
        console.print(f"[yellow]the box certificates do not cover this plant:[/] {outside}")
    console.print("assumptions of the certificates for the schedule:")
    certificate = next(c for under, c in found.certificates if under == SCHEDULE)
    print_assumptions(console, [a._asdict() for a in certificate.assumptions])
    console.print("assumptions of the paper's theorems:")
    print_assumptions(console, [a._asdict() for a in assumptions(found.resolved)])
    for sentence in in_words(found):
        console.print(sentence, markup=False, highlight=False)
    if found.weight is not None:
        rows = ",\n".join(f"  {[float(f'{v:.6g}') for v in row]}" for row in found.weight)
        console.print(
            f"for the scenario file:\n[trigger]\nweight = [\n{rows},\n]",
            markup=False, highlight=False, soft_wrap=True,
        )  # fmt: skip


def in_words(found: Study) -> Iterator[str]:
    """Yield sentences with the certified bounds for the scenario's schedule."""
    for under, certificate in found.certificates:
        constants, dropouts = certificate.constants, certificate.conditions.dropouts
        if under != SCHEDULE or constants is None:
            continue
        plants = "every plant of the box" if certificate.scope == BOX else "the scenario's plant"
        decay = f" e^(−{constants.rate_per_s:.3g}t)" if constants.rate_per_s else ""
        late = ""
        if (floor := certificate.floor_constants) is not None:
            late = f"; from {certificate.floor_from_s:.4g} s on, ‖x‖ ≤ {floor.state:.4g}"
        apart = ""
        if (spacing_s := certificate.inter_event_s) is not None:
            apart = f" The inter-event time is at least {_limit(spacing_s)}."
        yield (
            f"In words: for {plants}, under the assumptions above and for every pattern of at most "
            f"{dropouts} consecutive losses: ‖x‖ ≤ {constants.state:.4g}{decay}{late}.{apart}"
        )


def _print_constants(console: Console, found: Study) -> None:
    trigger = found.resolved.decaying
    norm = "‖W·‖" if trigger.weight is not None else "‖·‖"
    table = Table(
        title=f"{found.resolved.name}: certified bounds, M − 1 = {found.resolved.network.mansd}, "
        f"β = {trigger.beta:g}, α = {trigger.alpha_per_s:g} /s, errors in {norm}"
    )
    table.add_column("")
    for under, certificate in found.certificates:
        table.add_column(f"{under},\n{whose(certificate)}", justify="right")
    printed = found.theorem_2 is not None
    if printed:
        table.add_column("paper's\nTheorem 2", justify="right")
    for label, values, of_theorem in constants(found):
        table.add_row(label, *values, *([of_theorem] if printed else []))
    console.print(table)
    console.print(
        "[dim]All bounds are multiplied by e^(−rate·t). paper: no sampling, no delay, no hold. "
        "schedule: the scenario's rates, plus the lateness that it allows. plant: the scenario's "
        "plant. box: every plant of the uncertainty box.[/]"
    )
    for under, certificate in found.certificates:
        if certificate.void:
            console.print(
                f"[yellow]void[/] ({under}, {certificate.scope}): {escape(certificate.void)}"
            )


def whose(certificate: ScenarioCertificate) -> str:
    """Return which plants a certificate covers: "box" or "plant"."""
    return "box" if certificate.scope == BOX else "plant"


def constants(found: Study) -> Iterator[tuple[str, list[str], str]]:
    """Yield rows: label, the value of each certificate, the value of Theorem 2."""
    theorem, all_certificates = found.theorem_2, [c for _, c in found.certificates]

    def row(value: Callable[[ScenarioCertificate], float | None]) -> list[str]:
        return [number(value(c), 4) if c.constants else "void" for c in all_certificates]

    def constant(name: str) -> list[str]:
        return row(lambda c: getattr(c.constants, name))

    yield (
        "decay rate, 1/s",
        constant("rate_per_s"),
        number(found.resolved.decaying.alpha_per_s, 4),
    )
    yield "updates outstanding", constant("missing_events"), "-"
    yield (
        "Δ, bound of ‖e_c‖/β",
        constant("delta"),
        ("(same)" if theorem is not None else "-"),
    )
    yield "bound of ‖e_s‖/β", constant("overshoot"), "1"
    yield "bound of ‖u − Kx‖", constant("input_error"), "-"
    yield (
        "X, bound of ‖x‖",
        constant("state"),
        (number(theorem.state_start + theorem.state_forced, 4) if theorem is not None else "-"),
    )
    yield (
        "inter-event time, s",
        row(lambda c: c.inter_event_s),
        (number(theorem.inter_event_s, 4) if theorem is not None else "-"),
    )
    yield "loop gain (< 1)", constant("loop_gain"), "-"
    if any(c.floor_constants for c in all_certificates):
        yield "floor reached at, s", row(lambda c: c.floor_from_s), "-"
        for label, name in (("from then on, ‖e_c‖/ε", "delta"), ("from then on, ‖x‖", "state")):
            yield (
                label,
                row(
                    lambda c, name=name: getattr(c.floor_constants, name, None)  # type: ignore[misc]
                ),
                "-",
            )


def _print_limits(console: Console, found: Study) -> None:
    table = Table(title="schedule: largest value that is certified, one quantity at a time")
    for heading in ("", "sampling period", "delay of updates", "age of inputs"):
        table.add_column(heading, justify="right" if heading else "left")
    for scope, limits in found.limits.items():
        table.add_row(scope, *map(_limit, limits))
    console.print(table)


def _limit(value_s: float) -> str:
    if value_s <= 0:
        return "none"
    return "any" if value_s >= _MOST_S else duration(value_s)
