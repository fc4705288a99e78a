"""Receives /noack/state by zenoh-ros2-sdk; prints the messages after the last, at 3 s."""

import json
import sys
import threading

from rosbags.typesys import Stores, get_typestore
from zenoh_ros2_sdk import ROS2Subscriber
from zenoh_ros2_sdk.attachment import Attachment
from zenoh_ros2_sdk.session import ZenohSession

KIND = "sensor_msgs/msg/JointState"
store, port, last = get_typestore(Stores.ROS2_JAZZY), int(sys.argv[1]), threading.Event()
session = ZenohSession.get_instance("127.0.0.1", port)
messages: list[tuple[int, float, float]] = []


def definition(kind: str) -> str:
    return store.generate_msgdef(kind, ros_version=2)[0].partition("=" * 80)[0]


def on_state(message) -> None:  # type: ignore[no-untyped-def]
    stamp = message.header.stamp
    messages.append((stamp.sec * 10**9 + stamp.nanosec, *map(float, message.position[[0, -1]])))
    if messages[-1][0] >= 3 * 10**9:
        last.set()


for part in ("builtin_interfaces/msg/Time", "std_msgs/msg/Header"):
    session.register_message_type(definition(part), part)
ROS2Subscriber(
    "/noack/state", KIND, on_state, definition(KIND), router_port=port,
    type_hash=store.hash_rihs01(KIND),
)  # fmt: skip
attachments: list[tuple[int, int]] = []


def on_sample(sample) -> None:  # type: ignore[no-untyped-def]
    attached = Attachment.from_bytes(sample.attachment.to_bytes())
    attachments.append((attached.sequence_id, len(attached.gid)))


def on_token(token) -> None:  # type: ignore[no-untyped-def]
    tokens.append(str(token.key_expr))
    if "/MP/" in tokens[-1]:  # of a publisher
        joined.set()


raw = session.session.declare_subscriber("0/noack/state/**", on_sample)
tokens: list[str] = []
joined = threading.Event()
graph = session.liveliness.declare_subscriber("@ros2_lv/**", on_token, history=True)
last.wait()
joined.wait()
print(json.dumps({"messages": messages, "tokens": tokens, "attachments": attachments}), flush=True)
threading.Event().wait()
