"""A ``[network]`` section that reproduces a measured network, as a trace or as a model."""

from collections.abc import Mapping
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from cosim.record.run_directory import require_output, write_output
from netem.core import toml_file
from netem.core.errors import printable
from netem.core.file_access import require_suffix
from netem.core.number_checks import one_of
from netem.impairments.target_loss import read_files
from netem.measurement.chain_fits import ChainFit
from netem.measurement.network_measurement import NetworkMeasurement
from netem.traces.packet_trace import LOST_NS, PacketTrace
from noack.scenario.scenario_file import toml_text
from noack.scenario.sections import NetworkSection

Form = Literal["trace", "model"]
_SAMPLES = 101
"""Number of delay quantiles of a model."""
_MOST_CORRELATION = 0.99
"""The emulator requires less than 1."""


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
    loss = _loss(measurement.chosen.fit) if measurement.models else {"model": "lossless"}
    return {"loss": loss, "impairments": [*_outage_chain(measurement), *_delay(measurement)]}


def _loss(fit: ChainFit) -> Mapping[str, object]:
    if fit.model == "bernoulli":
        return {"model": "bernoulli", "probability": fit.rates.loss_in_bad}
    return {"model": "gilbert_elliott", **fit.rates._asdict()}


def _outage_chain(measurement: NetworkMeasurement) -> list[Mapping[str, object]]:
    """Return the outages as a chain of their own, by packets."""
    lengths = measurement.bursts.length[measurement.is_outage]
    if not len(lengths):
        return []
    usual = len(measurement.trace) - int(lengths.sum())
    chain = {
        "model": "gilbert_elliott",
        "good_to_bad": min(len(lengths) / max(usual, 1), 1.0),
        "bad_to_good": 1 / float(lengths.mean()),
    }
    return [{"kind": "loss", "loss": chain}]


def _delay(measurement: NetworkMeasurement) -> list[Mapping[str, object]]:
    """Return the delays of the effective packets; the others are lost in the model."""
    delays_ns = measurement.trace.delay_ns[measurement.outcomes.effective]
    if not len(delays_ns) or not delays_ns.any():
        return []
    if delays_ns.min() == delays_ns.max():
        return [{"kind": "delay", "delay_s": int(delays_ns[0]) * 1e-9}]
    samples_s = np.quantile(delays_ns, np.linspace(0, 1, _SAMPLES)) * 1e-9
    correlation = next(iter(measurement.delays.correlation.at_lags), 0.0)
    return [
        {
            "kind": "delay",
            "distribution": "empirical",
            "samples_s": np.round(samples_s, 9).tolist(),
            "correlation": round(min(max(correlation, 0.0), _MOST_CORRELATION), 4),
        }
    ]
