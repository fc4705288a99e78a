"""Messages and names of ROS 2. Two other readers read them in ``test_ros2_bag.py``."""

import numpy as np
import pytest

from noack_ros2 import ros2_messages as ros2

ENTRIES = ros2.Entries(1_234_567_890_123, ("y", "ψ"), np.array([0.1, -np.inf]))


def test_a_joint_state_is_unchanged_by_writing_and_reading() -> None:
    entries = ros2.read_joint_state(ros2.joint_state(ENTRIES, "lane"))
    assert entries[:2] == ENTRIES[:2]
    assert entries.values.tobytes() == ENTRIES.values.tobytes()


def test_no_part_of_a_joint_state_is_one() -> None:
    data = ros2.joint_state(ENTRIES, "lane")
    for size in range(len(data) - 1):
        with pytest.raises(ValueError, match=r"^not a sensor_msgs/msg/JointState: "):
            ros2.read_joint_state(data[:size])


@pytest.mark.parametrize(
    ("loop", "name"), [("lane-1", "lane_1"), ("2nd loop", "_2nd_loop"), ("größe", "gr__e")]
)
def test_a_loop_among_several_has_a_namespace(loop: str, name: str) -> None:
    assert ros2.namespace(loop, is_only=False) == f"/noack/{name}"
    assert ros2.namespace(loop, is_only=True) == "/noack"
