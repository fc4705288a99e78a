"""The page of a measurement: its tables and figures, as one HTML file."""

from pathlib import Path

from cosim.measurement.certificate_time import CertificateTime
from cosim.measurement.measurement_figures import measurement_figures
from cosim.measurement.measurement_tables import measurement_tables, void_remarks
from cosim.measurement.network_measurement import Measurement
from cosim.output.figure_files import save_figures
from cosim.output.figure_format import FigureFiles
from cosim.output.page_kit import templates
from noack.core.file_access import require_suffix, write_whole


def write_page(
    found: Measurement,
    void: CertificateTime | None,
    path: Path,
    figure_files: FigureFiles | None = None,
) -> list[Path]:
    """Write the page, in which all text is escaped, and its figures; return the files.

    Raises:
        CallerError: the name does not end in .html.
        MachineError: the page cannot be written.
    """
    require_suffix(path, "--out", ".html")
    template = templates(Path(__file__).parent).get_template("measurement.html.jinja")
    figures = list(measurement_figures(found))
    html = template.render(
        found=found,
        remarks=[*found.remarks, *void_remarks(void)],
        tables=list(measurement_tables(found, void)),
        figures=figures,
    )
    return [write_whole(path, html), *save_figures(figures, path, figure_files)]
