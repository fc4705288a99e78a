"""The report of a run of several loops: the network, all loops, and the worst one in detail."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from cosim.analysis.loops_over_time import LoopsOverTime, loops_over_time, worst_loop
from cosim.output.loops_tables import (
    CAPTION,
    HEADINGS,
    badness,
    loop_row,
    network_rows,
)
from cosim.output.report.loops_figures import (
    MOST_ROWS,
    NAMED,
    QueueLength,
    error_map,
    network_figure,
    norms_figure,
)
from cosim.output.report.report_page import environment_rows, templates
from cosim.output.report.run_figures import Envelope, RunFigure, pictures
from cosim.output.run_verdict import verdict
from cosim.record.loops_run import loop_directories
from cosim.record.run_directory import (
    ENVIRONMENT_FILE,
    LOOPS,
    REPORT_FILE,
    SCENARIO_FILE,
    read_object,
)
from cosim.record.run_record import RunRecord, load_record
from noack.core.errors import ExitStatus
from noack.core.file_access import write_whole
from noack.core.number_format import number, seconds

_OF_WORST = ("states", "errors", "losses")


def write_loops_report(
    network: RunRecord,
    summary: Mapping[str, Any],
    run_dir: Path,
    envelopes: Sequence[Envelope] = (),
) -> Path:
    """Write the report of a run of several loops; replace an existing one.

    Args:
        network: the record of the network.
        summary: the run's summary.
        run_dir: the run's directory.
        envelopes: certified bounds of the worst loop.

    Raises:
        CallerError: the record of a loop is missing.
        MachineError: the report cannot be written.
    """
    directories = loop_directories(run_dir, network.scenario)
    worst = worst_loop(run_dir, summary["loops"])
    drawings = pictures(load_record(directories[worst.number]), envelopes)
    lines = [line.text for line in verdict(dict(summary))]
    is_bad = summary["exit"]["status"] != ExitStatus.OK or "violated" in lines[1]
    environment = read_object(run_dir / ENVIRONMENT_FILE)
    loops = sorted(summary["loops"], key=badness, reverse=True)
    html = templates().get_template("loops.html.jinja").render(
        scenario=network.scenario,
        summary=summary,
        verdict_lines=lines,
        verdict_tone="bad" if is_bad else "doubt" if "void" in lines[1] else "good",
        network=network_rows(dict(summary)),
        figures=list(loops_pictures(network, run_dir, summary).values()),
        worst_name=directories[worst.number].name,
        worst_number=worst.number,
        worst_why=worst.why[:1].upper() + worst.why[1:],
        worst_phase=seconds(summary["loops"][worst.number]["phase_s"]),
        worst_figures=[drawings[name]() for name in _OF_WORST],
        caption=CAPTION,
        headings=HEADINGS,
        loops=[(_link(run_dir, loop["name"]), loop_row(loop)) for loop in loops],
        scenario_toml=(run_dir / SCENARIO_FILE).read_text(encoding="utf-8"),
        environment=environment,
        environment_rows=environment_rows(environment),
    )  # fmt: skip
    return write_whole(run_dir / REPORT_FILE, html)


def _link(run_dir: Path, name: str) -> str | None:
    """Return the address of a loop's report; None if it is not written."""
    path = Path(LOOPS, name, REPORT_FILE)
    return quote(path.as_posix()) if (run_dir / path).is_file() else None


def loops_pictures(
    network: RunRecord, run_dir: Path, summary: Mapping[str, Any]
) -> dict[str, RunFigure]:
    """Draw the figures of all loops, by name.

    Raises:
        CallerError: the record of a loop is missing.
    """
    directories = loop_directories(run_dir, network.scenario)
    figures = _figures(loops_over_time(network, map(load_record, directories)), summary)
    return {figure.name: figure for figure in figures}


def _figures(over_time: LoopsOverTime, summary: Mapping[str, Any]) -> list[RunFigure]:
    names = [loop["name"] for loop in summary["loops"]]
    flying = summary["network"]["in_flight"]
    queue = QueueLength(flying["width_s"], flying["mean_by_interval"], flying["max_by_interval"])
    drawn = (
        "Each loop has a curve."
        if len(names) <= NAMED
        else "Bands: quantiles over the loops; dashed: the largest value."
    )
    stayed = np.array([loop["diverged_at_s"] is None for loop in summary["loops"]])
    left = "" if stayed.all() else " A loop that diverged leaves the range of the axis."
    order = "" if len(names) <= MOST_ROWS else " Loops are numbered from 0, as in the scenario."
    largest = over_time.errors[np.isfinite(over_time.errors)].max(initial=0.0)
    return [
        RunFigure(
            "network", network_figure(over_time, names, queue),
            "Above: datagrams that wait, are sent or are delayed in the network. Below: each "
            f"loop's share of the bytes that left it. {drawn}",
            f"Above, the number of datagrams in the network over time, up to {flying['max']}. "
            f"Below, the shares of {len(names)} loops in the bytes that the network forwarded.",
        ),
        RunFigure(
            "loops", norms_figure(over_time, names, stayed),
            "Largest error ‖e_c‖ of the controller's model, and largest norm ‖x‖ of the plant's "
            f"state, in each of {len(over_time.middles_s)} intervals. {drawn}{left}",
            f"Norms of {len(names)} loops over time on logarithmic axes; ‖e_c‖ is at most "
            f"{number(largest)}.",
        ),
        RunFigure(
            "map", error_map(over_time, names, stayed),
            "Largest ‖e_c‖ of each loop in each interval; no colour before its first delivery."
            f"{order}",
            f"A row of colours for each of {len(names)} loops: ‖e_c‖ over time.",
        ),
    ]  # fmt: skip
