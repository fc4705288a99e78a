"""A ``[network]`` section that reproduces a measured network, as a trace or as a model."""

from collections.abc import Mapping
from pathlib import Path
from typing import Literal, get_args

from cosim.record.run_directory import require_output, write_output
from netem.core import toml_file
from netem.core.errors import printable
from netem.core.file_access import require_suffix
from netem.core.number_checks import one_of
from netem.impairments.target_loss import read_files
from netem.measurement.fitted_network import fitted_impairments, fitted_loss
from netem.measurement.network_measurement import NetworkMeasurement
from netem.traces.packet_trace import LOST_NS, PacketTrace
from noack.scenario.scenario_file import toml_text
from noack.scenario.sections import NetworkSection

Form = Literal["trace", "model"]


def write_network(measurement: NetworkMeasurement, path: Path, form: Form) -> list[Path]:
    """Write the section, and the trace that it names; return the written files.

    Raises:
        CallerError: the name does not end in .toml, the delays are not known, or the emulator cannot
            reproduce the network.
        MachineError: a file cannot be written.
    """
    require_suffix(path, "--write", ".toml")
    require_output(path)
    one_of("form", form, get_args(Form))
    measurement.require_delays("a network for a scenario (--write)")
    paths = [path]
    if form == "trace":
        trace_path = path.with_suffix(".csv")
        write_output(trace_path, trace_csv(measurement.trace))
        section, paths = _trace_section(measurement, trace_path.name), [trace_path, path]
    else:
        section = _model_section(measurement)
    cap = {"mansd": measurement.longest_loss_burst, "enforce_mansd": False}
    text = _comment(measurement, form) + toml_text({"network": {**cap, **section}})
    source = f"--write {path}"
    content = toml_file.parsed(text, source)["network"]
    assert isinstance(content, dict)
    settings = toml_file.validated(NetworkSection, content, source)
    read_files(settings.link, path.parent, source)
    write_output(path, text)
    return paths


def trace_csv(trace: PacketTrace) -> str:
    """Return a trace as CSV in ns; :func:`netem.traces.packet_trace.read_trace` reads the same."""
    columns = (trace.sequence.tolist(), trace.sent_ns.tolist(), trace.received_ns.tolist())
    rows = (
        f"{number},{sent},{'' if received == LOST_NS else received}\n"
        for number, sent, received in zip(*columns, strict=True)
    )
    return "sequence,sent_ns,received_ns\n" + "".join(rows)


def _comment(measurement: NetworkMeasurement, form: Form) -> str:
    deadline_s = measurement.options.deadline_s
    deadline = "" if deadline_s is None else f", deadline {deadline_s:g} s"
    lines = [f"Measured: {printable(measurement.name)}, {len(measurement.trace)} packets{deadline}."]
    if form == "trace":
        lines.append(
            'Each update gets what was recorded at its time. With by = "packet", update k gets record k.'
        )
    else:
        lines.append("A model, fitted per packet: it assumes updates at the trace's rate.")
    lines.append("mansd is not enforced, so that the network behaves as measured.")
    if measurement.is_outage.any():
        lines.append("mansd does not cover the outages; no certificate does.")
    hint = "; the CSV belongs beside it" if form == "trace" else ""
    lines.append(f"To use it: noack run SCENARIO --network with this file{hint}.")
    return "".join(f"# {line}\n" for line in lines)


def _trace_section(measurement: NetworkMeasurement, name: str) -> Mapping[str, object]:
    # The network would deliver the first packet.
    start = {} if measurement.outcomes.effective[0] else {"initial_sync": "known_state"}
    replay = {"kind": "replay", "file": name, "by": "time"}
    return start | {"loss": {"model": "lossless"}, "impairments": [replay]}


def _model_section(measurement: NetworkMeasurement) -> Mapping[str, object]:
    return {"loss": fitted_loss(measurement), "impairments": [*fitted_impairments(measurement)]}
