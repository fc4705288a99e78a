"""All outputs of a measurement: tables, page, JSON, and a ``[network]`` section.

The section reproduces the measured network, as a trace or as a model.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.console import Console

from cosim.live.progress import error_console
from cosim.measurement.chain_fits import ChainFit
from cosim.measurement.measurement_page import print_measurement, write_page
from cosim.measurement.network_measurement import Measurement
from cosim.output.figure_format import FigureFiles
from noack.config import toml_file
from noack.config.scenario import Scenario
from noack.config.scenario_file import toml_text
from noack.config.sections import NetworkSection
from noack.core.errors import CallerError, printable
from noack.core.file_access import require_suffix, write_whole
from noack.impairments.loss_prediction import read_files
from noack.traces.packet_trace import LOST_NS, PacketTrace

Form = Literal["trace", "model"]
_SAMPLES = 101
"""Number of delay quantiles of a model."""
_MOST_CORRELATION = 0.99


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
    with error_console().status("measuring"):
        void = None if request.scenario is None else found.certificate_time(request.scenario)
        document = found.to_json()
    if console is not None:
        print_measurement(console, found, void)
    written: list[Path] = []
    if request.page is not None:
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


def write_network(found: Measurement, path: Path, form: Form) -> list[Path]:
    """Write the section, and the trace that it names; return the written files.

    Raises:
        CallerError: the name does not end in .toml, or the emulator cannot reproduce the network.
        MachineError: a file cannot be written.
    """
    require_suffix(path, "--write", ".toml")
    written = [path]
    if form == "trace":
        trace_path = path.with_suffix(".csv")
        write_whole(trace_path, trace_csv(found.trace))
        section, written = _trace_section(found, trace_path.name), [trace_path, path]
    else:
        section = _model_section(found)
    cap = {"mansd": found.longest_loss_burst, "enforce_mansd": False}
    text = _comment(found, form) + toml_text({"network": {**cap, **section}})
    source = f"--write {path}"
    content = toml_file.parsed(text, source)["network"]
    loaded = toml_file.validated(NetworkSection, content, source)
    read_files(loaded.link, path.parent, source)
    write_whole(path, text)
    return written


def trace_csv(trace: PacketTrace) -> str:
    """Return a trace as CSV in ns; :func:`noack.traces.trace_formats.read_trace` reads the same."""
    columns = (trace.sequence.tolist(), trace.sent_ns.tolist(), trace.received_ns.tolist())
    rows = (
        f"{number},{sent},{'' if received == LOST_NS else received}\n"
        for number, sent, received in zip(*columns, strict=True)
    )
    return "sequence,sent_ns,received_ns\n" + "".join(rows)


def _comment(found: Measurement, form: Form) -> str:
    deadline_s = found.options.deadline_s
    late = "" if deadline_s is None else f", deadline {deadline_s:g} s"
    lines = [f"Measured: {printable(found.name)}, {len(found.trace)} packets{late}."]
    if form == "trace":
        lines += [
            "Each update gets what was recorded at its time. "
            'With by = "packet", update k gets record k.',
        ]
    else:
        lines += ["A model, fitted per packet: it assumes updates at the trace's rate."]
    lines += ["mansd is not enforced, so that the network behaves as measured."]
    if found.is_outage.any():
        lines += ["mansd does not cover the outages; no certificate does."]
    return "".join(f"# {line}\n" for line in lines)


def _trace_section(found: Measurement, name: str) -> Mapping[str, Any]:
    # The network would deliver the first packet.
    known = {} if found.outcomes.effective[0] else {"initial_sync": "known_state"}
    replay = {"kind": "replay", "file": name, "by": "time"}
    return known | {"loss": {"model": "lossless"}, "impairments": [replay]}


def _model_section(found: Measurement) -> Mapping[str, Any]:
    loss = _loss(found.chosen.fit) if found.models else {"model": "lossless"}
    return {"loss": loss, "impairments": [*_outage_chain(found), *_delay(found)]}


def _loss(fit: ChainFit) -> Mapping[str, Any]:
    if fit.model == "bernoulli":
        return {"model": "bernoulli", "probability": fit.rates.loss_in_bad}
    return {"model": "gilbert_elliott", **fit.rates._asdict()}


def _outage_chain(found: Measurement) -> list[Mapping[str, Any]]:
    """Return the outages as a chain of their own, by packets."""
    lengths = found.bursts.length[found.is_outage]
    if not len(lengths):
        return []
    usual = len(found.trace) - int(lengths.sum())
    chain = {
        "model": "gilbert_elliott",
        "good_to_bad": min(len(lengths) / max(usual, 1), 1.0),
        "bad_to_good": 1 / float(lengths.mean()),
    }
    return [{"kind": "loss", "loss": chain}]


def _delay(found: Measurement) -> list[Mapping[str, Any]]:
    """Return the delays of the effective packets; the others are lost in the model."""
    delays_ns = found.trace.delay_ns[found.outcomes.effective]
    if not len(delays_ns) or not delays_ns.any():
        return []
    if delays_ns.min() == delays_ns.max():
        return [{"kind": "delay", "delay_s": int(delays_ns[0]) * 1e-9}]
    samples_s = np.quantile(delays_ns, np.linspace(0, 1, _SAMPLES)) * 1e-9
    correlation = found.delays.correlation[0] if found.delays.correlation else 0.0
    return [{
        "kind": "delay", "distribution": "empirical",
        "samples_s": np.round(samples_s, 9).tolist(),
        "correlation": round(min(max(correlation, 0.0), _MOST_CORRELATION), 4),
    }]  # fmt: skip
