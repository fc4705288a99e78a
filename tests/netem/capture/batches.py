"""Batches of events, and random ones."""

import ipaddress
import random
from typing import Any

import numpy as np
from hypothesis import strategies as st

from netem.capture import PcapngSection
from netem.relay_links import EVENT, Bytes, Events, LinkSpec
from noack.impairments.link_settings import LinkSettings

T_NS = 1_767_225_600_123_456_789
SPECS = [
    LinkSpec("link0", ("127.0.0.1", 1), ("127.0.0.1", 2), LinkSettings(), LinkSettings())
]  # fmt: skip
INTERFACES = (("link0 client", "127.0.0.1:1"), ("link0 server", "127.0.0.1:2"))
USUAL: dict[str, Any] = {
    "t_ns": T_NS, "family": 4, "source_port": 40_001, "destination_port": 40_002,
    "source": "192.0.2.1", "destination": "198.51.100.7", "flow": 3, "packet": 17,
    "mansd": -1, "bit": -1, "payload": b"payload",
}  # fmt: skip

i64 = st.integers(0, 2**63 - 1)
SHARED = {
    "t_ns": i64, "interface": st.integers(0, 1), "departure": st.integers(0, 1),
    "direction": st.integers(0, 1), "fate": st.integers(0, 5), "copy": st.integers(0, 1),
    "stale": st.integers(0, 1), "source_port": st.integers(0, 65_535),
    "destination_port": st.integers(0, 65_535), "flow": i64, "packet": i64,
    "consecutive_losses": i64,
    "mansd": st.integers(-1, 2**63 - 1), "delay_ns": i64, "hold_back_ns": i64,
    "bit": st.integers(-1, 2**63 - 1),
}  # fmt: skip


def of_family(family: int) -> st.SearchStrategy[dict[str, Any]]:
    addresses = st.ip_addresses(v=family).map(str)
    large = st.builds(
        lambda size, seed: random.Random(seed).randbytes(size),
        st.integers(0, 65_507),
        st.integers(0, 9),
    )
    return st.fixed_dictionaries(
        SHARED
        | {
            "family": st.just(family), "source": addresses, "destination": addresses,
            "payload": st.binary(max_size=40) | large,
        }
    )  # fmt: skip


events = of_family(4) | of_family(6)


def batch(*described: dict[str, Any]) -> tuple[Events, Bytes]:
    """Return events with these fields, payloads and addresses; other fields have default values."""
    table = np.zeros(len(described), EVENT)
    data = b"other bytes"
    for row, given in zip(table, described, strict=True):
        fields = USUAL | given
        payload = fields.pop("payload")
        row["size_bytes"], row["offset"] = len(payload), len(data)
        data += payload
        for name, value in fields.items():
            if isinstance(value, str):
                packed = ipaddress.ip_address(value).packed
                row[name][: len(packed)] = list(packed)
            else:
                row[name] = value
    return table, np.frombuffer(data, np.uint8)


def file_of(*described: dict[str, Any]) -> bytes:
    """Return a whole capture file."""
    section = PcapngSection(INTERFACES)
    return section.header() + bytes(section.packets(*batch(*described))) + section.statistics()
