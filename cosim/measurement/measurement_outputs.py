"""All outputs of a measurement: tables, page, ``[network]`` section, JSON."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from cosim.live.progress import PatientConsole
from cosim.measurement.measurement_tables import print_measurement
from cosim.measurement.network_file import Form, write_network
from cosim.measurement.network_measurement import Measurement
from cosim.output.figure_format import FigureFiles
from noack.config.scenario import Scenario
from noack.core.errors import CallerError
from noack.core.file_access import require_suffix


@dataclass(frozen=True)
class OutputRequest:
    """What to write besides the tables."""

    page: Path | None = None
    figure_files: FigureFiles | None = None
    """Format and width of the figures beside the page."""
    network: Path | None = None
    form: Form = "trace"
    scenario: Scenario | None = None
    """A scenario whose certificates are compared with the network."""

    def __post_init__(self) -> None:
        """Refuse wrong names before anything is measured."""
        if self.figure_files is not None and self.page is None:
            raise CallerError("--format: the figures are beside the page; give --out FILE.html")
        if self.page is not None:
            require_suffix(self.page, "--out", ".html")
        if self.network is not None:
            require_suffix(self.network, "--write", ".toml")


def report(found: Measurement, request: OutputRequest, console: Console | None) -> dict[str, Any]:
    """Write what is requested, print the tables, and return the document of ``--json``.

    Raises:
        NoackError: one line; a file cannot be written, or the scenario cannot be resolved.
    """
    with PatientConsole(stderr=True).status("measuring"):
        void = None if request.scenario is None else found.certificate_time(request.scenario)
        document = found.to_json()
    if console is not None:
        print_measurement(console, found, void)
    written: list[Path] = []
    if request.page is not None:
        from cosim.measurement.measurement_page import write_page

        written += write_page(found, void, request.page, request.figure_files)
    if request.network is not None:
        written += write_network(found, request.network, request.form)
    if console is not None:
        for path in written:
            console.print(f"written: {path}", markup=False, highlight=False, soft_wrap=True)
    document["written"] = [str(path) for path in written]
    if void is not None:
        document["certificate"] = void.to_json()
    return document
