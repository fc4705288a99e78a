"""Writes a ``[network]`` section that reproduces a measured network, as a trace or as a model."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from cosim.measurement.chain_fits import ChainFit
from cosim.measurement.network_measurement import Measurement
from noack.config import toml_file
from noack.config.scenario_file import toml_text
from noack.config.sections import NetworkSection
from noack.core.errors import printable
from noack.core.file_access import require_suffix, write_whole
from noack.impairments.loss_prediction import read_files
from noack.traces.packet_trace import LOST_NS, PacketTrace

Form = Literal["trace", "model"]
_SAMPLES = 101
"""Number of delay quantiles of a model."""
_MOST_CORRELATION = 0.99


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
    text = _comment(found, form) + toml_text({"network": section})
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


def _common(found: Measurement) -> dict[str, Any]:
    return {"mansd": found.longest_loss_burst, "enforce_mansd": False}


def _trace_section(found: Measurement, name: str) -> Mapping[str, Any]:
    section = _common(found)
    if not found.outcomes.effective[0]:  # the network would deliver the first packet
        section["initial_sync"] = "known_state"
    replay = {"kind": "replay", "file": name, "by": "time"}
    return section | {"loss": {"model": "lossless"}, "impairments": [replay]}


def _model_section(found: Measurement) -> Mapping[str, Any]:
    impairments = [*_outage_chain(found), *_delay(found)]
    loss = _loss(found.chosen.fit) if found.models else {"model": "lossless"}
    return _common(found) | {"loss": loss, "impairments": impairments}


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
