"""Sources of a measurement: runs, delivery opportunities, and what is refused."""

import gzip
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import noack
from cosim.measurement.run_trace import read_source, updates_trace
from cosim.record.run_events import packet_outcomes
from cosim.simulation.virtual_time import simulate
from netem.core.errors import CallerError
from netem.measurement.trace_sources import SourceOptions
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import validate
from tests.oracles.capture_files import Sent, pcap_of


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


NUMBERED = [Sent(k * 10**7, struct.pack(">I", k)) for k in range(40) if k % 7]


def test_a_compressed_capture_is_read_as_the_capture(tmp_path: Path) -> None:
    path, compressed = tmp_path / "capture.pcap", tmp_path / "capture.pcap.gz"
    path.write_bytes(pcap_of(*NUMBERED))
    compressed.write_bytes(gzip.compress(path.read_bytes()))
    whole = tmp_path / "sender.pcap.gz"
    whole.write_bytes(gzip.compress(pcap_of(*(Sent(k * 10**7, struct.pack(">I", k)) for k in range(40)))))
    options = SourceOptions(sequence_at="0:4")
    expected = read_source([path], options)
    assert expected.lost.sum() == 5
    for trace in (read_source([compressed], options), noack.measure(compressed, sequence_at="0:4").trace):
        assert trace.received_ns.tolist() == expected.received_ns.tolist()
    assert read_source([whole, compressed]).lost.sum() >= 5


def test_files_that_cannot_be_measured_are_refused_in_one_line(tmp_path: Path) -> None:
    csv = tmp_path / "a.csv"
    csv.write_text("sent_ms,received_ms\n0,1\n")
    empty, compressed_empty = tmp_path / "empty.pcap", tmp_path / "empty.gz"
    empty.write_bytes(b"")
    compressed_empty.write_bytes(gzip.compress(b""))
    opportunities = tmp_path / "link.up.gz"
    opportunities.write_bytes(gzip.compress(b"0\n30\n100\n"))
    capture, other = tmp_path / "capture.pcap", tmp_path / "other.pcap"
    capture.write_bytes(pcap_of(*NUMBERED))
    other.write_bytes(pcap_of())
    for paths, options, message in (
        ([tmp_path], SourceOptions(), str(tmp_path)),
        ([tmp_path / "none"], SourceOptions(), "No such file"),
        ([csv, csv], SourceOptions(), "expected one file, or two captures"),
        ([csv], SourceOptions(sequence_at="0:4"), "--sequence-at: has no effect on a packet trace"),
        ([empty], SourceOptions(), "empty.pcap: is empty"),
        ([empty], SourceOptions(sequence_at="0:4"), "empty.pcap: is empty"),
        ([compressed_empty], SourceOptions(), "empty.gz: is empty"),
        ([opportunities], SourceOptions(), "not read compressed"),
        ([capture, other], SourceOptions(), "^[^,]*/other.pcap: has no UDP datagrams"),
        ([capture], SourceOptions(False, sequence_at="0:4"), "--clocks: has no effect on one end"),
    ):
        with pytest.raises(CallerError, match=message) as error:
            read_source(paths, options)
        assert "\n" not in str(error.value)
