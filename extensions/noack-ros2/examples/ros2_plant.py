"""The plant of docs/ros2.md as a node of ROS 2, without an installation of ROS.

It uses the package zenoh-ros2-sdk. A node in rclpy has the same callback: it receives a
`sensor_msgs/msg/JointState` on /noack/plant/input, and answers on /noack/plant/state.
"""

import sys
import threading

import numpy as np
from rosbags.typesys import Stores, get_typestore
from scipy.linalg import expm
from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber
from zenoh_ros2_sdk.session import ZenohSession

port = int(sys.argv[1]) if len(sys.argv) > 1 else 7447
A, B, X0 = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [0.9]]), np.array([1.0, 0.0])
kind = "sensor_msgs/msg/JointState"
store = get_typestore(Stores.ROS2_JAZZY)
parts = ("builtin_interfaces/msg/Time", "std_msgs/msg/Header", kind)
definitions = {part: store.generate_msgdef(part, ros_version=2)[0].partition("=" * 80)[0] for part in parts}
x, t_ns = X0.copy(), 0


def on_input(message: object) -> None:
    """Advance to the stamp under the input; answer with the state."""
    global x, t_ns
    stamp = message.header.stamp
    asked_ns = stamp.sec * 10**9 + stamp.nanosec
    if asked_ns == 0:
        x = X0.copy()
    elif asked_ns > t_ns:
        step = expm(np.block([[A, B], [np.zeros((1, 3))]]) * (asked_ns - t_ns) * 1e-9)
        x = step[:2, :2] @ x + step[:2, 2:] @ message.position
    t_ns, none = asked_ns, np.zeros(0)
    publisher.publish(
        header=message.header, name=["position", "velocity"], position=x, velocity=none, effort=none
    )


network = {"router_port": port, "type_hash": store.hash_rihs01(kind)}
for part in parts[:-1]:
    ZenohSession.get_instance("127.0.0.1", port).register_message_type(definitions[part], part)
publisher = ROS2Publisher("/noack/plant/state", kind, definitions[kind], **network)
subscriber = ROS2Subscriber("/noack/plant/input", kind, on_input, definitions[kind], **network)
print("ready", flush=True)
threading.Event().wait()
