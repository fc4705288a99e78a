"""A run as MCAP, read by an independent reader and compared with the record."""

import json
import shutil
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader

import noack
from cosim.output.export.export_formats import export_run
from cosim.output.viewer.rerun_program import start_rerun
from noack.scenario.resolution import ResolvedRun
from tests.helpers.named_scenario import named_content

SCENARIO: dict[str, Any] = {
    "horizon_s": 1.0, "changes": [{"at_s": 0.5, "set": {"trigger.beta": 0.05}}],
}  # fmt: skip


@pytest.fixture(scope="module")
def run() -> noack.Run:
    return noack.simulate(noack.load("lane_following", SCENARIO))


def vector(table: pa.Table, name: str) -> np.ndarray:
    names = [column for column in table.column_names if column.startswith(f"{name}_")]
    return np.column_stack([table[column].to_numpy() for column in names])


def messages(path: Path) -> dict[str, list[tuple[int, int, dict[str, Any]]]]:
    """Log time, publish time and content of the messages by topic, each valid by its schema."""
    by_topic: dict[str, list[tuple[int, int, dict[str, Any]]]] = {}
    assert_log_times_ascend(path)
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            content = json.loads(message.data)
            if not by_topic.setdefault(channel.topic, []):
                jsonschema.validate(content, json.loads(schema.data))
            by_topic[channel.topic].append((message.log_time, message.publish_time, content))
    return by_topic


def assert_log_times_ascend(path: Path) -> None:
    """In the order of the file: players read it from the front."""
    with path.open("rb") as file:
        records = StreamReader(file, record_size_limit=None).records
        times = [record.log_time for record in records if isinstance(record, Message)]
    assert times == sorted(times)
    assert times


def test_an_mcap_file_has_the_record(run: noack.Run, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    run.export(path)
    by_topic = messages(path)
    for name in run.tables:
        owner, _, rest = name.partition("_")
        assert len(by_topic.get(f"/{owner}/{rest}", ())) == run.table(name).num_rows
    steps = run.table("plant_step")
    x = np.array([content["x"] for *_, content in by_topic["/plant/step"]])
    assert x.tobytes() == vector(steps, "x").tobytes()
    assert [log for log, *_ in by_topic["/plant/step"]] == steps["now_ns"].to_pylist()
    assert [publish for _, publish, _ in by_topic["/plant/step"]] == steps["t_ns"].to_pylist()
    (change,) = [content["change"] for *_, content in by_topic["/sensor/setting"]]
    assert json.loads(change)
    head = run.table("netem_packet")["head"][0].as_py().hex()
    assert by_topic["/netem/packet"][0][2]["head"] == head
    samples = run.samples().to_pylist()
    for (log_ns, _, content), row in zip(by_topic["/loop/errors"], samples, strict=True):
        assert (log_ns, content["e_s_norm"]) == (row["t_ns"], row["e_s_norm"])
        assert content["e_c_norm"] == (None if np.isnan(row["e_c_norm"]) else row["e_c_norm"])


def test_impossible_times_of_a_damaged_record_do_not_prevent_an_mcap_file(
    run: noack.Run, tmp_path: Path
) -> None:
    damaged = tmp_path / "damaged"
    shutil.copytree(run.directory, damaged)
    for name, t_ns in (("sensor_measurement", -1), ("plant_step", 2**62)):
        path = damaged / "record" / f"{name}.parquet"
        table = pq.read_table(path)
        times = pa.array(np.full(len(table), t_ns))
        pq.write_table(table.set_column(table.column_names.index("t_ns"), "t_ns", times), path)
    export_run(damaged, tmp_path / "run.mcap")
    assert {at_ns for at_ns, _, _ in messages(tmp_path / "run.mcap")["/loop/errors"]} == {0}


def test_rerun_finds_no_fault_in_an_mcap_file(run: noack.Run, tmp_path: Path) -> None:
    run.export(tmp_path / "run.mcap")
    program = start_rerun(["mcap", "check", str(tmp_path / "run.mcap")])
    assert program.wait(timeout=120) == 0


def test_channels_of_several_loops_have_the_loops_names(tmp_path: Path) -> None:
    loops = noack.simulate(noack.load("shared_bottleneck", {"horizon_s": 0.2, "loops.0.count": 2}))
    path, of_ros = loops.export(tmp_path / "a.mcap")
    assert_log_times_ascend(of_ros)
    by_topic = messages(path)
    name, loop = list(loops.loops.items())[-1]
    steps = loop.table("plant_step")["now_ns"].to_pylist()
    phase_ns = ResolvedRun(loops.scenario).phases_ns[-1]
    times = [log - phase_ns for log, *_ in by_topic[f"/{name}/plant/step"]]
    assert phase_ns > 0
    assert times == steps
    assert len(by_topic["/netem/packet"]) == loops.table("netem_packet").num_rows


@pytest.mark.parametrize("names", [
    ["lateral offset [m]", "<b>", "{}", "x" * 64, "[/]"], ["a, b", "a/b", "\\", "שלום", "e\u0301"],
])  # fmt: skip
def test_unusual_names_are_in_the_file(names: list[str], tmp_path: Path) -> None:
    run = noack.simulate(noack.load(named_content(names[:2], names[2:3], names[3:])))
    written = run.export(tmp_path / "run.mcap")
    assert messages(tmp_path / "run.mcap")["/plant/step"]
    for path in written:
        assert_log_times_ascend(path)
    with (tmp_path / "run.mcap").open("rb") as file:
        channels = [channel for _, channel, _ in make_reader(file).iter_messages() if channel.metadata]
    for channel in channels:
        assert json.loads(channel.metadata["states"]) == names[:2]
        assert json.loads(channel.metadata["inputs"]) == names[2:3]
    assert "/plant/step" in {channel.topic for channel in channels}
