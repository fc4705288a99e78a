"""The margin of a loop as a table."""

from collections.abc import Iterator

from rich.console import Console
from rich.table import Table

from cosim.analysis.margin_search import MarginResult
from cosim.output.result_tables import ResultTable

_STYLES = {"stable": "green", "destabilised": "red", "undecided": "yellow"}


MARGIN_HEADINGS = ("M", "maximum consecutive losses (M − 1)", "at least", "at most", "verdict")


def margin_title(margin: MarginResult) -> str:
    """Return the title of the table of the bounds."""
    delay = f", updates delayed by {margin.delay_s:g} s" if margin.delay_s else ""
    mode = "model-based" if margin.mode == "model" else "zero-order hold"
    times = f"with an update every {margin.period_s:g} s"
    if not margin.is_periodic:
        times = f"with updates {margin.shortest_s:g} to {margin.period_s:g} s apart"
    return (
        f"{margin.scenario}: growth of the worst loss pattern per {margin.period_s:g} s, "
        f"{times}, {mode}{delay}"
    )


def margin_rows(margin: MarginResult) -> Iterator[tuple[str, ...]]:
    """Yield the rows of the table of the bounds."""
    for m, found in margin.caps:
        yield str(m), str(m - 1), f"{found.lower:.9f}", f"{found.upper:.9f}", found.verdict


def print_margin(console: Console, margin: MarginResult) -> None:
    """Print the bounds for each M, and the verdicts."""
    table = Table(title=margin_title(margin))
    for heading in MARGIN_HEADINGS:
        table.add_column(heading, justify="left" if heading == "verdict" else "right")
    for *cells, verdict in margin_rows(margin):
        table.add_row(*cells, f"[{_STYLES[verdict]}]{verdict}[/]")
    console.print(table)
    console.print(margin.verdict, soft_wrap=True, highlight=False)
    if margin.period is not None:
        text = f"for {margin.guarantee}: {margin.period.text}"
        console.print(text, soft_wrap=True, highlight=False)
    console.print(margin.random_text, soft_wrap=True, highlight=False, markup=False)
    note = "D delivered, L lost, repeated. Below 1: every pattern is stable."
    if not margin.is_periodic:
        note += " In brackets: the time to the next update."
    console.print(f"[dim]{note}[/]")


def margin_tables(margin: MarginResult) -> Iterator[ResultTable]:
    """Yield the bounds of the growth for each M."""
    rows = [*margin_rows(margin)]
    yield ResultTable("margin", margin_title(margin), MARGIN_HEADINGS, rows)
