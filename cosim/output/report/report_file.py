"""Writes ``report.html`` into a run directory."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from cosim.output.report.figure_files import inline
from cosim.output.report.report_page import Embedded, page
from cosim.output.report.run_figures import Envelope, run_figures
from cosim.record.run_directory import ENVIRONMENT_FILE, REPORT_FILE, SCENARIO_FILE, read_object
from cosim.record.run_record import RunRecord
from noack.core.file_access import write_whole


def write_report(
    record: RunRecord,
    summary: Mapping[str, Any],
    run_dir: Path,
    envelopes: Sequence[Envelope] = (),
) -> Path:
    """Write the report of a run; replace an existing one.

    Args:
        record: the run's record.
        summary: the run's summary.
        run_dir: the run's directory.
        envelopes: certified bounds, drawn with the quantities that they bound.

    Returns:
        The report's path.

    Raises:
        MachineError: the report cannot be written.
    """
    timed = summary.get("kind") != "simulated"
    figures = [
        Embedded(
            found.name, Markup(inline(found.figure, found.name, found.description)), found.caption
        )
        for found in run_figures(record, envelopes, timed=timed)
    ]
    scenario_toml = (run_dir / SCENARIO_FILE).read_text(encoding="utf-8")
    environment = read_object(run_dir / ENVIRONMENT_FILE)
    html = page(record.scenario, summary, figures, scenario_toml, environment)
    return write_whole(run_dir / REPORT_FILE, html)
