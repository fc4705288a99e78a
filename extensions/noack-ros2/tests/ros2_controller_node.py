"""The controller u = K x_c of the tests as a node, by zenoh-ros2-sdk."""

import sys
import threading

import numpy as np
from rosbags.typesys import Stores, get_typestore
from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber
from zenoh_ros2_sdk.session import ZenohSession

KIND = "sensor_msgs/msg/JointState"
store, port = get_typestore(Stores.ROS2_JAZZY), int(sys.argv[1])
session = ZenohSession.get_instance("127.0.0.1", port)


def definition(kind: str) -> str:
    return store.generate_msgdef(kind, ros_version=2)[0].partition("=" * 80)[0]


def on_state(message) -> None:  # type: ignore[no-untyped-def]
    u, none = np.array([[-1.0, -1.4]]) @ message.position, np.zeros(0)
    publisher.publish(header=message.header, name=["u"], position=u, velocity=none, effort=none)


for part in ("builtin_interfaces/msg/Time", "std_msgs/msg/Header"):
    session.register_message_type(definition(part), part)
wire = {"router_port": port, "type_hash": store.hash_rihs01(KIND)}
publisher = ROS2Publisher("/noack/controller/input", KIND, definition(KIND), **wire)
subscriber = ROS2Subscriber("/noack/controller/state", KIND, on_state, definition(KIND), **wire)
threading.Event().wait()
