"""The certificates of a scenario, as tables and as JSON."""

import contextlib
from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Any, NamedTuple

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cosim.output.assumptions_table import print_assumptions
from cosim.output.row_display import Rows, as_html, as_text
from cosim.output.unlimited_losses_report import print_unlimited
from noack.config.resolution import loop_of, resolve
from noack.config.scenario import Scenario
from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix
from noack.core.number_format import NONE, duration, number
from noack.impairments.markov_chain import NotPredictableError
from noack.theory.assumptions import assumptions
from noack.theory.certificate import NetworkConditions
from noack.theory.enclosure import NotDecayingError
from noack.theory.loss_margin import LossMargin, Stability
from noack.theory.paper_bounds import Theorem2, theorem_2
from noack.theory.run_conditions import ideal_conditions, nominal_conditions
from noack.theory.scenario_certificates import (
    BOX,
    OWN_PLANT,
    CertificateScope,
    ScenarioCertificate,
    box,
    outside_box,
    own_plant,
)
from noack.theory.setpoint_shift import about_setpoint, void_at_setpoint
from noack.theory.unlimited_losses import UnlimitedLosses, unlimited_losses
from noack.theory.weight import choose_weight
from noack.trigger.decaying import DecayingSettings
from noack.trigger.periodic_trigger import PeriodicSettings

IDEAL = "paper"
"""The paper's conditions: no sampling, no delay, no hold."""
SCHEDULE = "schedule"
"""The scenario's rates, and the lateness that it allows."""

_PERSISTENT = {
    "‖e_c‖": "delta", "‖e_s‖": "overshoot", "‖u − Kx‖": "input_error", "‖x‖": "state",
    "‖x̂ − x‖": "estimation_error",
}  # fmt: skip
"""Rows of the bounds that are added under disturbances, noise or an observer."""

MOST_LATE = 1000
_MOST_S = 10.0


class NetworkLimits(NamedTuple):
    """Largest certified value of each quantity; the others are those of the schedule."""

    sampling_s: float
    delay_s: float
    hold_s: float


class Certificates:
    """The certificates of a scenario's plant, and of all plants in its uncertainty box.

    A certificate has ``constants``, or None with the reason in ``void``. It has ``conditions`` on
    network and schedule, which it assumes, and ``assumptions``, each with its verdict. It has
    ``inter_event_s``, the minimum inter-event time δ̲, and three bounds as functions of time in
    seconds: ``sensor_error``, ``controller_error`` and ``state``. The constants include ``delta``,
    Δ of ‖e_c‖ ≤ Δβe^(−αt), ``state``, X of ‖x‖ ≤ Xe^(−αt), and ``rate_per_s``, the decay rate of
    all bounds. ``docs/theory.md`` derives them.

    Iteration yields each certificate with the conditions that it assumes: IDEAL or SCHEDULE.

    Args:
        scenario: the resolved scenario.
        late_periods: allowed lateness in steps of the plant.
        weight: W, if noack chose it.

    Raises:
        CallerError: its updates are acknowledged, its plant or controller is nonlinear, or its
            settings change.
    """

    scenario: Scenario
    """The resolved scenario of the certificates, with the requested weight, about its set-point."""
    setpoint: tuple[float, ...] | None
    """x_r; all bounds of x are those of x − x_r. None: 0."""
    theorem_2: Theorem2 | None
    """Theorem 2 by the paper's formula, with Δ of ``paper``; None if it cannot be evaluated."""
    weight: Matrix | None
    """W of the trigger's norm, (n, n), if this call chose it; else None."""

    unlimited: UnlimitedLosses | None
    """What holds without a limit on the losses; None if the network enforces its guarantee, or if
    the losses are no Markov chain over the packets (``unpredictable`` is the reason)."""
    unpredictable: str | None

    def __init__(self, scenario: Scenario, late_periods: int, weight: Matrix | None = None) -> None:
        scenario.coverage.require_constant()
        scenario.coverage.require_certifiable()
        self.setpoint, void = scenario.controller.setpoint, void_at_setpoint(scenario)
        if OWN_PLANT in void:
            raise CallerError(f"controller.setpoint: {void[OWN_PLANT]}")
        scenario = about_setpoint(scenario)
        self.scenario, self.weight = scenario, weight
        self._scheduled = nominal_conditions(scenario, late_periods)
        conditions = {IDEAL: ideal_conditions(scenario), SCHEDULE: self._scheduled}
        scopes = (own_plant(scenario), None if BOX in void else box(scenario))
        self._scopes = [scope for scope in scopes if scope is not None]
        self._certificates = [
            (under, scope.certificate(of)) for under, of in conditions.items()
            for scope in self._scopes
        ]  # fmt: skip
        self.theorem_2 = _theorem_2(scenario, self.paper)
        self.unlimited, self.unpredictable = self._unlimited()

    def __iter__(self) -> Iterator[tuple[str, ScenarioCertificate]]:
        return iter(self._certificates)

    @property
    def paper(self) -> ScenarioCertificate:
        """Under the paper's conditions: no sampling, no delay and no held input."""
        return self._of(IDEAL)[0]

    @property
    def schedule(self) -> ScenarioCertificate:
        """Under the scenario's own schedule, with its permitted lateness."""
        return self._of(SCHEDULE)[0]

    @property
    def paper_box(self) -> ScenarioCertificate | None:
        """For every plant in the box, under the paper's conditions; None if there is no box."""
        return next(iter(self._of(IDEAL)[1:]), None)

    @property
    def schedule_box(self) -> ScenarioCertificate | None:
        """For every plant in the box, under the scenario's schedule; None if there is no box."""
        return next(iter(self._of(SCHEDULE)[1:]), None)

    @property
    def limits(self) -> NetworkLimits:
        """Limits of the schedule's times for the scenario's plant, each varied alone, in s.

        They are computed at the first access, which takes about a second.
        """
        return next(iter(self._limits.values()))

    @cached_property
    def stability(self) -> Stability | None:
        """What is known about the stability of all loss patterns, if the loop is time-triggered.

        None for other loops, and where the exact margin does not cover the schedule.
        """
        if not isinstance(self.scenario.trigger, PeriodicSettings):
            return None
        with contextlib.suppress(CallerError):
            return LossMargin(self.scenario).first_bounds()
        return None

    def to_json(self) -> dict[str, Any]:
        """Return all certificates as one document, as ``noack certify --json`` prints it."""
        return {
            "scenario": self.scenario.name,
            "setpoint": self.setpoint,
            "weight": None if self.weight is None else self.weight.tolist(),
            "paper": {
                "assumptions": [a._asdict() for a in assumptions(self.scenario)],
                "theorem_2": None if self.theorem_2 is None else self.theorem_2._asdict(),
            },
            "certificates": [{"under": under, **one.to_json()} for under, one in self],
            "stability": None if self.stability is None else self.stability._asdict(),
            "unlimited_losses": None if self.unlimited is None else self.unlimited.to_json(),
            "limits": {scope: limits._asdict() for scope, limits in self._limits.items()},
        }

    @cached_property
    def _limits(self) -> dict[str, NetworkLimits]:
        """Limits by scope, from about a hundred certificates."""
        return {scope.name: _limits(scope, self._scheduled) for scope in self._scopes}

    def _unlimited(self) -> tuple[UnlimitedLosses | None, str | None]:
        if self.scenario.network.enforce_mansd:
            return None, None
        try:
            return unlimited_losses(self.scenario, self._scopes[0], self._scheduled), None
        except NotPredictableError as error:
            return None, str(error)

    def _of(self, conditions: str) -> list[ScenarioCertificate]:
        return [one for under, one in self if under == conditions]

    def _rows(self) -> Rows:
        heads = [f"{under}, {_whose(one)}" for under, one in self]
        rows = [[label, *values] for label, values, _ in _constants(self)]
        return [[self.scenario.name, *heads], *rows]

    def __repr__(self) -> str:
        return as_text(self._rows())

    def _repr_html_(self) -> str:
        return as_html(self._rows())


def _theorem_2(scenario: Scenario, certificate: ScenarioCertificate) -> Theorem2 | None:
    trigger, constants = scenario.trigger, certificate.constants
    if not isinstance(trigger, DecayingSettings) or constants is None:
        return None
    if constants.rate_per_s != trigger.alpha_per_s:
        return None
    if trigger.floor or trigger.weight is not None or not scenario.coverage.is_undisturbed:
        return None
    return theorem_2(loop_of(scenario), trigger.beta, trigger.alpha_per_s, constants.delta)


def with_weight(
    resolved: Scenario,
    which: str,
    late_periods: int = 0,
    progress: Callable[[float], None] = lambda share: None,
) -> tuple[Scenario, Matrix | None]:
    """Return the scenario with the requested weight, and W if noack chose it for its schedule.

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
                loop_of(resolved), trigger.beta, trigger.alpha_per_s,
                nominal_conditions(resolved, late_periods), progress,
            )  # fmt: skip
        except NotDecayingError as error:
            raise CallerError(f"weight chosen: {error}") from None
    elif which != "identity":
        raise CallerError(f'weight: given, identity or chosen, not "{which}"')
    rows = None if weight is None else tuple(tuple(row) for row in weight.tolist())
    trigger = resolved.decaying.model_copy(update={"weight": rows})
    return resolved.model_copy(update={"trigger": trigger}), weight


def certificates_of(
    scenario: Scenario,
    weight: str = "given",
    late_periods: int | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> Certificates:
    """Certify a scenario under the paper's conditions and under its own schedule.

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
    weighted, W = with_weight(resolved, weight, allowed, progress)
    return Certificates(weighted, allowed, W)


def _limits(scope: CertificateScope, scheduled: NetworkConditions) -> NetworkLimits:
    sampled = scope.largest(
        scheduled, lambda c, value: c._replace(sampling_s=value, spacing_s=value), _MOST_S
    )
    delayed = scope.largest(
        scheduled, lambda c, value: c._replace(delay_s=value, start_s=value), _MOST_S
    )
    held = scope.largest(scheduled, lambda c, value: c._replace(hold_s=value), _MOST_S)
    return NetworkLimits(sampled, delayed, held)


def print_certificates(console: Console, found: Certificates) -> None:
    """Print the tables."""
    _print_constants(console, found)
    if any(found.setpoint or ()):
        console.print("[dim]x is the distance from the set-point, x − x_r.[/]")
    _print_limits(console, found)
    if (outside := outside_box(found.scenario)) is not None:
        console.print(f"[yellow]the box certificates do not cover this plant:[/] {outside}")
    console.print("assumptions of the certificates for the schedule:")
    print_assumptions(console, [a._asdict() for a in found.schedule.assumptions])
    console.print("assumptions of the paper's theorems:")
    print_assumptions(console, [a._asdict() for a in assumptions(found.scenario)])
    print_unlimited(console, found.unlimited, found.unpredictable)
    for sentence in (*_in_words(found), *_stability_in_words(found)):
        console.print(sentence, markup=False, highlight=False)
    if found.weight is not None:
        rows = ",\n".join(f"  {[float(f'{v:.6g}') for v in row]}" for row in found.weight)
        console.print(
            f"for the scenario file:\n[trigger]\nweight = [\n{rows},\n]",
            markup=False, highlight=False, soft_wrap=True,
        )  # fmt: skip


def _in_words(found: Certificates) -> Iterator[str]:
    """Yield sentences with the certified bounds for the scenario's schedule."""
    for under, certificate in found:
        constants = certificate.constants
        if under != SCHEDULE or constants is None:
            continue
        plants = "every plant of the box" if certificate.scope == BOX else "the scenario's plant"
        decay = f" e^(−{constants.rate_per_s:.3g}t)" if constants.rate_per_s else ""
        late = ""
        if (floor := certificate.floor_constants) is not None:
            late = f"; from {certificate.floor_from_s:.4g} s on, ‖x‖ ≤ {floor.state:.4g}"
        if (rest := certificate.persistent_constants) is not None:
            late = f" + {rest.state:.4g}"
        apart = ""
        if (spacing_s := certificate.inter_event_s) is not None:
            apart = f" The inter-event time is at least {_limit(spacing_s)}."
        yield (
            f"In words: for {plants}, under the assumptions above and for every pattern of losses "
            f"with {certificate.conditions.guarantee.meaning}: "
            f"‖x‖ ≤ {constants.state:.4g}{decay}{late}.{apart}"
        )


def _stability_in_words(found: Certificates) -> Iterator[str]:
    """Yield what is known exactly about the stability of a time-triggered loop."""
    if (known := found.stability) is None:
        return
    patterns = f"patterns with {found.scenario.network.guarantee.meaning}"
    growth = f"growth per period {known.lower:.4g} to {known.upper:.4g}"
    text = {
        "stable": f"all {patterns} are stable: {growth}",
        "destabilised": f"the pattern {known.text}, repeated, destabilises the loop: {growth}",
        "undecided": f"{growth} under the worst of all {patterns}",
    }[known.verdict]
    yield f"Exactly, but without lateness: {text}; noack margin finds the limits."


def _print_constants(console: Console, found: Certificates) -> None:
    trigger = found.scenario.trigger
    norm = "‖W·‖" if trigger.weight is not None else "‖·‖"
    guarantee = next(iter(found))[1].conditions.guarantee  # its longest burst counts all rules
    table = Table(
        title=f"{found.scenario.name}: certified bounds, "
        f"{guarantee.meaning}; event: {trigger.description}; norm {norm}"
    )
    table.add_column("")
    for under, certificate in found:
        table.add_column(f"{under},\n{_whose(certificate)}", justify="right")
    printed = found.theorem_2 is not None
    if printed:
        table.add_column("paper's\nTheorem 2", justify="right")
    for label, values, of_theorem in _constants(found):
        table.add_row(label, *values, *([of_theorem] if printed else []))
    console.print(table)
    console.print(
        "[dim]Each bound of a norm is multiplied by e^(−rate·t). paper: no sampling, no delay, no "
        "hold. schedule: the scenario's rates, plus the lateness that it allows. plant: the "
        "scenario's plant. box: every plant of the uncertainty box. updates outstanding: maximum "
        "number of updates lost or in flight. no update missing: while the controller has every "
        "update, which sharpens the bound of x from an event on. inter-event time: minimum.[/]"
    )
    if not found.scenario.coverage.is_undisturbed:
        console.print(
            "[dim]The rows with + are added: they are the bounds from disturbances, noise and the "
            "threshold's floor. With noise or an observer, e_s and e_c are x_s − x̂ and x_c − x̂.[/]"
        )
    for under, certificate in found:
        if certificate.void:
            console.print(
                f"[yellow]void[/] ({under}, {certificate.scope}): {escape(certificate.void)}"
            )


def _whose(certificate: ScenarioCertificate) -> str:
    """Return which plants a certificate covers: "box" or "plant"."""
    return "box" if certificate.scope == BOX else "plant"


def _constants(found: Certificates) -> Iterator[tuple[str, list[str], str]]:
    """Yield rows: label, the value of each certificate, the value of Theorem 2."""
    certificates = [certificate for _, certificate in found]

    def row(value: Callable[[ScenarioCertificate], float | None]) -> list[str]:
        return [number(value(c), 4) if c.constants else "void" for c in certificates]

    def constant(name: str) -> list[str]:
        return row(lambda c: getattr(c.constants, name))

    def after(name: str, which: str) -> list[str]:
        return row(lambda c: getattr(getattr(c, which), name, None))

    delta_2 = state_2 = spacing_2 = NONE
    if (theorem := found.theorem_2) is not None:
        delta_2 = "(same)"
        state_2 = number(theorem.state_start + theorem.state_forced, 4)
        spacing_2 = number(theorem.inter_event_s, 4)
    rate_2 = number(found.scenario.trigger.threshold_decay_per_s, 4)
    yield "decay rate, 1/s", constant("rate_per_s"), rate_2
    yield "updates outstanding", constant("missing_events"), NONE
    unit = next((f"/{one.unit}" for one in certificates if one.unit), "")
    yield f"Δ, bound of ‖e_c‖{unit}", constant("delta"), delta_2
    yield f"bound of ‖e_s‖{unit}", constant("overshoot"), "1"
    yield "bound of ‖u − Kx‖", constant("input_error"), NONE
    yield "· no update missing", constant("received_input_error"), NONE
    yield "X, bound of ‖x‖", constant("state"), state_2
    yield "inter-event time, s", row(lambda c: c.inter_event_s), spacing_2
    yield "loop gain (< 1)", constant("loop_gain"), NONE
    if any(c.persistent_constants for c in certificates):
        for label, name in _PERSISTENT.items():
            yield f"+ without decay: {label}", after(name, "persistent_constants"), NONE
    if any(c.floor_constants for c in certificates):
        yield "floor reached at, s", row(lambda c: c.floor_from_s), NONE
        yield "bound of ‖e_c‖/ε from then on", after("delta", "floor_constants"), NONE
        yield "bound of ‖x‖ from then on", after("state", "floor_constants"), NONE


def _print_limits(console: Console, found: Certificates) -> None:
    table = Table(title="schedule: largest certified value of each quantity, the others unchanged")
    for heading in ("", "sampling period", "delay of updates", "age of inputs"):
        table.add_column(heading, justify="right" if heading else "left")
    for scope, limits in found._limits.items():
        table.add_row(scope, *map(_limit, limits))
    console.print(table)


def _limit(value_s: float) -> str:
    if value_s <= 0:
        return "none"
    return "any" if value_s >= _MOST_S else duration(value_s)
