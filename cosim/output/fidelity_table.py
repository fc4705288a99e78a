"""Tables of a run's fidelity: its difference from the ideal loop, effect by effect."""

from collections.abc import Iterator

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cosim.analysis.fidelity import Fidelity, SignalDifference, is_against
from cosim.analysis.summary_model import FidelityPart, NoFidelityPart
from noack.core.number_format import NONE, percent


def print_fidelity(console: Console, fidelity: Fidelity) -> None:
    """Print the effects from the ideal loop to the run, and the verdict."""
    table = Table(title=f"{fidelity.scenario}: difference in x to the ideal loop")
    table.add_column("effect", no_wrap=True)
    for heading in ("RMS", "max", "share", "events", "Δt, ms", "split at event"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_row("(ideal loop)", "", "", "", str(fidelity.events_ideal), "", "")
    for stage in fidelity.stages:
        table.add_row(
            stage.name,
            *_sizes(stage.difference),
            percent(stage.share),
            str(stage.events),
            _milliseconds(stage.max_event_difference_s),
            _event(stage.first_different_event),
        )
    table.add_section()
    table.add_row(
        "total",
        *_sizes(fidelity.total),
        "100.0 %",
        str(fidelity.events_live),
        _milliseconds(fidelity.max_event_difference_s),
        _event(fidelity.first_different_event),
    )
    console.print(table)
    console.print(_by_state(fidelity))
    console.print(
        "Each row adds one effect to the rows above. RMS, max: of the norm, in model units. Δt: "
        "largest change of an event's time. split at event: number of the first event that moves "
        "by more than ten measurement periods; from there on, the recorded losses fall on other "
        "events. A negative share partly cancels the other effects.",
        highlight=False,
    )
    colour = "green" if fidelity.explained else "bold red"
    console.print(f"[{colour}]{escape(fidelity.verdict)}[/]", highlight=False)


def summary_rows(fidelity: FidelityPart | NoFidelityPart | None) -> Iterator[tuple[str, str]]:
    """Yield the rows of fidelity for the table of a run."""
    if fidelity is None:
        return
    if isinstance(fidelity, NoFidelityPart):
        yield "difference to the ideal loop", f"not compared: {fidelity.reason}"
        return
    scale = fidelity.rms_x_live
    of_x = f" ({100 * fidelity.rms_x / scale:.2g} % of x)" if scale else ""
    yield "difference to the ideal loop, RMS", f"{fidelity.rms_x:.3g}{of_x}"
    for name, share in fidelity.shares.items():
        if name != "residual":
            against = " (partly cancels the other effects)" if is_against(share) else ""
            yield f"  {name.replace('_', ' ')}", percent(share) + against
    yield "  residual, RMS", f"{100 * fidelity.explained_relative:.2g} % of the difference"


def _by_state(fidelity: Fidelity) -> Table:
    table = Table(title="RMS by state")
    table.add_column("effect", no_wrap=True)
    for name in fidelity.state_names:
        table.add_column(escape(name), justify="right")
    rows = [(stage.name, stage.difference) for stage in fidelity.stages]
    for name, difference in [*rows, ("total", fidelity.total)]:
        table.add_row(name, *(f"{value:.2e}" for value in difference.rms_by_state))
    return table


def _sizes(difference: SignalDifference) -> tuple[str, str]:
    return f"{difference.rms:.2e}", f"{difference.max:.2e}"


def _milliseconds(value_s: float | None) -> str:
    return NONE if value_s is None else f"{1e3 * value_s:.1f}"


def _event(number: int | None) -> str:
    return NONE if number is None else f"{number}"
