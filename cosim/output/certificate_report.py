"""The certificates of a scenario, as tables and in words."""

from collections.abc import Iterator

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cosim.output.all_certificates import SCHEDULE, Certificates
from cosim.output.assumptions_table import print_assumptions
from cosim.output.certificate_rows import constant_rows, plants_of
from cosim.output.result_tables import ResultTable
from cosim.output.unlimited_losses_report import print_unlimited
from noack.core.number_format import duration
from noack.theory.certificates.assumptions import assumptions
from noack.theory.certificates.certified_bounds import envelope_formula
from noack.theory.certificates.conditions import BOX
from noack.theory.certificates.scenario_certificates import MOST_S, outside_box


def print_certificates(console: Console, found: Certificates) -> None:
    """Print the tables."""
    _print_constants(console, found)
    if any(found.setpoint or ()):
        console.print(
            "[dim]x is the distance from the set-point, x − x_r. If the plant does not rest there, "
            "A x_r + B u_r is a disturbance: a step at the state.[/]"
        )
    if any(certificate.constants for _, certificate in found):
        _print_limits(console, found)
    if (outside := outside_box(found.scenario)) is not None:
        console.print(f"[yellow]the box certificates do not cover this plant:[/] {outside}")
    console.print("assumptions of the certificates for the schedule:")
    print_assumptions(console, found.schedule.assumptions)
    console.print("assumptions of the paper's theorems:")
    print_assumptions(console, assumptions(found.scenario))
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
        apart = ""
        if (spacing_s := certificate.inter_event_s) is not None:
            apart = f" The inter-event time is at least {_limit(spacing_s)}."
        yield (
            f"In words: for {plants}, under the assumptions above and for every pattern of losses "
            f"with {certificate.conditions.guarantee.meaning}: "
            f"{envelope_formula('‖x‖', certificate, 'state').format(constants.state)}.{apart}"
        )


def _stability_in_words(found: Certificates) -> Iterator[str]:
    """Yield what is known exactly about the stability of a time-triggered loop."""
    if (known := found.stability) is None:
        return
    patterns = f"patterns with {found.scenario.network.guarantee.meaning}"
    growth = f"growth per period {known.lower:.4g} to {known.upper:.4g}"
    text = {
        "stable": f"all {patterns} are stable: {growth}",
        "destabilised": f"the pattern {known.text} (D delivered, L lost), repeated, "
        f"destabilises the loop: {growth}",
        "undecided": f"{growth} under the worst of all {patterns}",
    }[known.verdict]
    yield f"Exactly, but without lateness: {text}; noack margin finds the limits."


def constant_table(found: Certificates) -> tuple[str, list[str], list[tuple[str, ...]]]:
    """Return title, headings and rows of the table of constants."""
    trigger = found.scenario.trigger
    norm = "‖W·‖" if trigger.weight is not None else "‖·‖"
    guarantee = next(iter(found))[1].conditions.guarantee  # its longest burst counts all rules
    title = (
        f"{found.scenario.name}: certified bounds, "
        f"{guarantee.meaning}; event: {trigger.description}; norm {norm}"
    )
    headings = ["", *(f"{under},\n{plants_of(certificate)}" for under, certificate in found)]
    printed = found.theorem_2 is not None
    headings += ["paper's\nTheorem 2"] if printed else []
    certificates, rate = [one for _, one in found], trigger.threshold_decay_per_s
    rows = [
        (label, *values, *([of_theorem] if printed else []))
        for label, values, of_theorem in constant_rows(certificates, found.theorem_2, rate)
    ]
    return title, headings, rows


def _print_constants(console: Console, found: Certificates) -> None:
    title, headings, rows = constant_table(found)
    table = Table(title=title)
    for heading in headings:
        table.add_column(heading, justify="right" if heading else "left")
    for row in rows:
        table.add_row(*row)
    console.print(table)
    certificates = [one for _, one in found]
    if any(one.constants for one in certificates):
        console.print(
            "[dim]Each bound of a norm is multiplied by e^(−rate·t). paper: no sampling, no delay, "
            "no hold. schedule: the scenario's rates, plus the lateness that it allows. plant: the "
            "scenario's plant. box: every plant of the uncertainty box. updates outstanding: "
            "maximum number of updates lost or in flight. no update missing: while the controller "
            "has every update, which sharpens the bound of x from an event on. inter-event time: "
            "minimum.[/]"
        )
    if any(one.persistent_constants for one in certificates):
        console.print(
            "[dim]The rows with + are added: they are the bounds from disturbances, noise, and the "
            "threshold's constant or floor. With noise or an observer, e_s and e_c are x_s − x̂ and "
            "x_c − x̂.[/]"
        )
    if any(one.other for one in certificates):
        console.print(
            "[dim]Two bounds hold at all times. The table has the one that tends to the smaller "
            "value; both are in the words below.[/]"
        )
    for under, certificate in found:
        if certificate.void:
            console.print(
                f"[yellow]void[/] ({under}, {certificate.scope}): {escape(certificate.void)}"
            )
    policy = found.scenario.trigger.policy
    if found.weight is None and policy == "decaying" and any(c.void for c in certificates):
        console.print("--weight chosen searches for a norm in which more is certified")


LIMIT_HEADINGS = ("", "sampling period", "delay of updates", "age of inputs")


def limit_rows(found: Certificates) -> Iterator[tuple[str, ...]]:
    """Yield the rows of the table of limits."""
    for scope, limits in found.limits_by_scope.items():
        yield scope, *map(_limit, limits)


def _print_limits(console: Console, found: Certificates) -> None:
    table = Table(title="schedule: largest certified value of each quantity, the others unchanged")
    for heading in LIMIT_HEADINGS:
        table.add_column(heading, justify="right" if heading else "left")
    for row in limit_rows(found):
        table.add_row(*row)
    console.print(table)


def _limit(value_s: float) -> str:
    if value_s <= 0:
        return "none"
    return "any" if value_s >= MOST_S else duration(value_s)


def certificate_tables(found: Certificates) -> Iterator[ResultTable]:
    """Yield the certified constants, and the largest certified times of the schedule."""
    title, headings, rows = constant_table(found)
    yield ResultTable("certificates", title, headings, rows)
    if any(certificate.constants for _, certificate in found):
        caption = f"{found.scenario.name}: largest certified values of the {SCHEDULE}"
        yield ResultTable("limits", caption, LIMIT_HEADINGS, [*limit_rows(found)])
