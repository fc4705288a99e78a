"""The tables of a run's summary, for papers."""

from collections.abc import Iterator

from cosim.analysis.summary_model import RunSummary
from cosim.output.network_table import HEADINGS, loop_row, network_rows
from cosim.output.result_tables import KEY_VALUE, ResultTable
from cosim.output.run_tables import (
    TIMING_HEADINGS,
    claim_headings,
    claim_rows,
    key_numbers,
    run_title,
    timing_rows,
)


def summary_tables(summary: RunSummary) -> Iterator[ResultTable]:
    """Yield the network and a row for each loop; of one loop, key numbers, claims and timing."""
    if len(summary.loops) > 1:
        title = f"{summary.scenario}, M − 1 = {summary.mansd}"
        yield ResultTable("network", f"network of {title}", KEY_VALUE, network_rows(summary))
        rows = [loop_row(loop) for loop in summary.loops]
        yield ResultTable("loops", f"loops of {title}", HEADINGS, rows)
        return
    (loop,), title = summary.loops, run_title(summary)
    yield ResultTable("numbers", title, KEY_VALUE, key_numbers(summary))
    if claims := loop.claims:
        rows = [row.cells for row in claim_rows(claims)]
        yield ResultTable("claims", f"claims: {title}", claim_headings(claims), rows)
    if loop.lateness_us:
        caption = f"timing in µs of wall time: {title}"
        yield ResultTable("timing", caption, ("", *TIMING_HEADINGS), [*timing_rows(loop)])
