"""Sources of a measurement: runs, delivery opportunities, and what is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.measurement.trace_sources import SourceOptions, read_source, updates_trace
from cosim.record.run_events import packet_outcomes
from cosim.simulation.virtual_time import simulate
from noack.core.errors import CallerError
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import validate


def test_a_run_gives_its_effective_losses(content: dict[str, Any]) -> None:
    content |= {"horizon_s": 5.0, "trigger": {"policy": "periodic", "period_s": 0.05}}
    loss = {"model": "bernoulli", "probability": 0.3}
    delay = {"kind": "delay", "delay_s": 0.1, "jitter_s": 0.1}
    content["network"] = {"mansd": 4, "loss": loss, "impairments": [delay]}
    record = simulate(resolve(validate(content, "test")))
    outcomes = packet_outcomes(record)
    trace = updates_trace(record)
    newest = np.minimum.accumulate(np.where(trace.lost, 2**62, trace.received_ns)[::-1])[::-1]
    effective = ~trace.lost & (trace.received_ns <= newest)
    assert (~effective).tolist() == outcomes.lost[: len(trace)].tolist()
    assert outcomes.lost.any()


def test_opportunities_delay_a_probe_until_the_next_one(tmp_path: Path) -> None:
    path = tmp_path / "link.up"
    times_ms = [0, 30, 31, 100, 200]
    path.write_text("".join(f"{t}\n" for t in times_ms))
    trace = read_source([path], SourceOptions(period_ns=20_000_000))
    # An opportunity at the very time of an arrival is lost, as in mahimahi.
    expected = [min(t for t in times_ms if t > sent_ms) - sent_ms for sent_ms in range(0, 200, 20)]
    assert trace.delay_ns.tolist() == [delay_ms * 10**6 for delay_ms in expected]
    assert "5 in 0.2 s, 0.3008 Mbit/s; longest time without one: 100 ms, before 0.2 s" in trace.notes[0]


def test_files_that_cannot_be_measured_are_refused_in_one_line(tmp_path: Path) -> None:
    csv = tmp_path / "a.csv"
    csv.write_text("sent_ms,received_ms\n0,1\n")
    for paths, options, message in (
        ([tmp_path], SourceOptions(), str(tmp_path)),
        ([tmp_path / "none"], SourceOptions(), "No such file"),
        ([csv, csv], SourceOptions(), "expected one file, or two captures"),
        ([csv], SourceOptions(sequence_at="0:4"), "--sequence-at: has no effect on a packet trace"),
    ):
        with pytest.raises(CallerError, match=message) as error:
            read_source(paths, options)
        assert "\n" not in str(error.value)
