"""Sources of a measurement: fate files, runs, delivery opportunities, and what is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from cosim.measurement.trace_sources import SourceOptions, read_source, updates_trace
from cosim.record.run_events import packet_outcomes
from cosim.simulation.virtual_time import simulate
from netem.fates import description
from noack.core.errors import CallerError
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import validate
from tests.fuzz.parsers.fates import SPECS, TABLE


def test_a_fate_file_gives_the_first_intact_delivery(tmp_path: Path) -> None:
    path = tmp_path / "fates.parquet"
    pq.write_table(TABLE.replace_schema_metadata(description(SPECS, 0)), path)
    trace = read_source([path])
    assert trace.notes[0] == "flow 1: up forward, flow 0, 4 packets; --flow chooses another of the 3 flows"
    assert trace.sent_ns.tolist() == [0, 10, 20, 30]
    # Delivered; dropped; corrupted, but its copy is intact and arrives 9 ns later; forced.
    assert trace.delay_ns.tolist() == [5, -1, 9, 5]
    assert len(read_source([path], SourceOptions(flow=3))) == 1
    with pytest.raises(CallerError, match="has no flow 4; its flows are 1 to 3"):
        read_source([path], SourceOptions(flow=4))
    incomplete = TABLE.replace_schema_metadata(description(SPECS, 7))
    pq.write_table(incomplete, path)
    with pytest.raises(CallerError, match="7 events are missing"):
        read_source([path])
    pq.write_table(pa.table({"a": [1]}), path)
    with pytest.raises(CallerError, match="not a fate trace"):
        read_source([path])


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
