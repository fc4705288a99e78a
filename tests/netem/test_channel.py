"""The network of a run without sockets, against the plain one in Python."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from netem.channel import Channel, channel_of
from netem.link_state import LinkState
from noack.core.core_library import core, ffi
from noack.impairments.link_settings import LinkSettings
from noack.protocol.record_tables import PACKET_HEAD_BYTES
from noack.protocol.roles import Record
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import validate
from tests.netem.stepped_channel import SteppedChannel
from tests.noack.impairments.any_link_settings import capped, computable, harsh
from tests.oracles.link import Datagram, Duplex, Link

LOOPS = 4
any_link = st.one_of(computable, harsh, capped)
arrivals = st.lists(
    st.tuples(
        st.integers(0, 2 * LOOPS - 1), st.sampled_from([0, 1, 20, 32, 72, 1500]),
        st.one_of(st.integers(0, 10**7), st.integers(0, 10**10)), st.booleans(),
    ),
    max_size=60,
)  # fmt: skip
"""Flow, size, time since the datagram before, and whether what is due has left."""


def content_of(outputs: Sequence[Any]) -> tuple[list[tuple[int, bytes]], list[Any]]:
    datagrams = [(output.flow, output.data) for output in outputs if not isinstance(output, Record)]
    rows = [(output.table, *map(plain, output.row)) for output in outputs if isinstance(output, Record)]
    return datagrams, rows


def plain(value: Any) -> bytes | int:
    return bytes(value) if isinstance(value, bytes | np.void) else int(value)


@pytest.mark.sanitized
@given(any_link, any_link, st.none() | any_link, arrivals)
def test_the_channel_does_what_the_plain_network_does(
    first: LinkSettings,
    second: LinkSettings,
    later: LinkSettings | None,
    arriving: Sequence[tuple[int, int, int, bool]],
) -> None:
    named = (first, 5, "update"), (second, 5, "actuation")
    forward, reverse = (Link(*arguments, loops=LOOPS) for arguments in named)
    expected = Duplex(forward, reverse, loops=LOOPS)
    links = [LinkState(*arguments, rows=LOOPS) for arguments in named]
    channel = SteppedChannel(Channel(links, loops=LOOPS))
    now_ns, rng = 0, np.random.default_rng(1)
    for k, (flow, size, step_ns, leaves) in enumerate(arriving):
        if later is not None and k == len(arriving) // 2:
            changed = later.model_copy(update={"first_delivered": first.first_delivered})
            forward.change(changed)
            channel.channel.change(changed)
        now_ns += step_ns
        while leaves and (due_ns := expected.next_deadline_ns()) is not None and due_ns <= now_ns:
            assert channel.next_deadline_ns() == due_ns
            assert content_of(channel.on_timer(now_ns)) == content_of(expected.on_timer(now_ns))
        data = rng.bytes(size)
        if k % 2 and size >= PACKET_HEAD_BYTES:  # an update with an error level
            data = b"NA\1\2\2" + data[5:]
        datagram = Datagram(flow, data)
        assert content_of(channel.handle(datagram, now_ns)) == content_of(expected.handle(datagram, now_ns))
    while (due_ns := expected.next_deadline_ns()) is not None:
        assert channel.next_deadline_ns() == due_ns
        assert content_of(channel.on_timer(due_ns)) == content_of(expected.on_timer(due_ns))
    assert channel.next_deadline_ns() is None
    assert [link.counters for link in channel.channel.links] == [forward.counters, reverse.counters]


def test_the_channel_makes_room_for_any_number_of_delayed_datagrams(content: dict[str, Any]) -> None:
    delay = {"kind": "delay", "delay_s": 1.0}
    network = content["network"] | {"loss": {"model": "lossless"}, "impairments": [delay]}
    channel = SteppedChannel(channel_of(resolve(validate(content | {"network": network}, ""))))
    sent = [bytes([k % 256, k // 256]) for k in range(1000)]
    for k, data in enumerate(sent):
        assert not content_of(channel.handle(Datagram(0, data), k))[0]
    left = [content_of(channel.on_timer(10**9 + k))[0] for k in range(1000)]
    assert left == [[(0, data)] for data in sent]


@pytest.mark.sanitized
def test_numbers_of_no_network_are_refused(content: dict[str, Any]) -> None:
    channel = channel_of(resolve(validate(content, "")))
    own = channel.core
    for name, value in (
        ("loops", 0), ("loops", 2), ("directions", 3), ("places", 1), ("row_places", 0),
        ("heap_count", -1), ("packet_count", own.row_places + 1),
    ):  # fmt: skip
        before = getattr(own, name)
        setattr(own, name, value)
        assert core.noack_channel_check(own) != ffi.NULL
        setattr(own, name, before)
        assert core.noack_channel_check(own) == ffi.NULL
