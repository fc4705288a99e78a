"""The ROS 2 messages of an exported run, read by two independent readers."""

from pathlib import Path

import numpy as np
import pytest
from rosbags import rosbag2, typesys

import noack
from noack.scenario.resolution import loop_of, resolve

mcap_ros2 = pytest.importorskip("mcap_ros2.reader", reason="mcap-ros2-support is not installed")


def by_rosbags(path: Path) -> dict[str, list[tuple[int, str, list[str], list[float]]]]:
    """Log time, frame, names and values of the messages by topic."""
    store, by_topic = typesys.get_typestore(typesys.Stores.EMPTY), {}
    with rosbag2.Reader(path) as reader:
        for connection in reader.connections:
            store.register(typesys.get_types_from_msg(connection.msgdef.data, connection.msgtype))
        for connection, log_ns, data in reader.messages():
            if connection.msgtype == "sensor_msgs/msg/JointState":
                message = store.deserialize_cdr(data, connection.msgtype)
                content = log_ns, message.header.frame_id, message.name, message.position.tolist()
                by_topic.setdefault(connection.topic, []).append(content)
    return by_topic


def by_mcap_ros2(path: Path) -> dict[str, list[tuple[int, str, list[str], list[float]]]]:
    by_topic: dict[str, list[tuple[int, str, list[str], list[float]]]] = {}
    for entry in mcap_ros2.read_ros2_messages(path):
        if entry.schema.name == "sensor_msgs/msg/JointState":
            message = entry.ros_msg
            content = (
                entry.log_time_ns, message.header.frame_id, list(message.name),
                list(message.position),
            )  # fmt: skip
            by_topic.setdefault(entry.channel.topic, []).append(content)
    return by_topic


def test_two_readers_find_the_record(tmp_path: Path) -> None:
    run = noack.simulate(noack.load("lane_following", {"horizon_s": 1.0}))
    _, path = run.export(tmp_path / "run.mcap")
    by_topic = by_rosbags(path)
    assert by_topic == by_mcap_ros2(path)
    steps = run.table("plant_step")
    names = [*loop_of(resolve(run.scenario)).state_names]
    for topic, column in (("state", "x"), ("input", "u")):
        entries = [name for name in steps.column_names if name.startswith(f"{column}_")]
        recorded = np.column_stack([steps[name].to_numpy() for name in entries])
        messages = by_topic[f"/noack/{topic}"]
        assert np.array([values for *_, values in messages]).tobytes() == recorded.tobytes()
        assert [log_ns for log_ns, *_ in messages] == steps["now_ns"].to_pylist()
    assert by_topic["/noack/state"][0][1:3] == ("lane_following", names)
    assert len(by_topic["/noack/event"]) == run.summary.loops[0].events
    assert len(by_topic["/noack/update"]) == run.table("controller_delivery").num_rows


def test_loops_have_namespaces(tmp_path: Path) -> None:
    run = noack.simulate(noack.load("shared_bottleneck", {"horizon_s": 0.1}))
    _, path = run.export(tmp_path / "run.mcap")
    topics = {topic for topic in by_rosbags(path) if topic.endswith("/state")}
    assert topics == {f"/noack/{name.replace('-', '_')}/state" for name in run.loops}
