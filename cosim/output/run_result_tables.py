"""The tables of a run's summary, for papers."""

from collections.abc import Iterator

from cosim.analysis.loops_summary import has_loops
from cosim.analysis.run_summary import Summary
from cosim.output.loops_tables import HEADINGS, loop_row, network_rows
from cosim.output.result_tables import KEY_VALUE, ResultTable
from cosim.output.run_tables import (
    TIMING_HEADINGS,
    claim_headings,
    claim_rows,
    key_numbers,
    run_title,
    timing_rows,
)


def summary_tables(summary: Summary) -> Iterator[ResultTable]:
    """Yield key numbers, claims and timing of a run; of several loops, network and loops."""
    if has_loops(summary):
        title = f"{summary['scenario']}, M − 1 = {summary['mansd']}"
        yield ResultTable("network", f"network of {title}", KEY_VALUE, network_rows(summary))
        rows = [loop_row(loop) for loop in summary["loops"]]
        yield ResultTable("loops", f"loops of {title}", HEADINGS, rows)
        return
    title = run_title(summary)
    yield ResultTable("numbers", title, KEY_VALUE, key_numbers(summary))
    if claims := summary.get("claims"):
        rows = [row.cells for row in claim_rows(claims)]
        yield ResultTable("claims", f"claims: {title}", claim_headings(claims), rows)
    if summary["lateness_us"]:
        caption = f"timing in µs of wall time: {title}"
        yield ResultTable("timing", caption, ("", *TIMING_HEADINGS), [*timing_rows(summary)])
