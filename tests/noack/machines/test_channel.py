"""The network of a run without sockets: each packet leaves as its row says, and is counted."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from netem.core.packet_rows import PACKET_HEAD_BYTES, Fate
from netem.impairments.link_settings import LinkSettings
from netem.link_state import LinkState
from noack.core.core_library import new_handle
from noack.machines.run_channel import Datagram, RunChannel, channel_of
from noack.protocol.roles import Record
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import validate
from tests.netem.impairments.any_link_settings import capped, computable, harsh
from tests.noack.machines.stepped_channel import SteppedChannel

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
    rows = [(output.table, *output.row) for output in outputs if isinstance(output, Record)]
    return datagrams, rows


@pytest.mark.sanitized
@given(any_link, any_link, st.none() | any_link, arrivals)
def test_each_packet_leaves_as_its_row_says(
    first: LinkSettings,
    second: LinkSettings,
    later: LinkSettings | None,
    arriving: Sequence[tuple[int, int, int, bool]],
) -> None:
    """What waits for the link's next decision may leave later than its row says."""
    links = [LinkState(first, 5, "update", rows=LOOPS), LinkState(second, 5, "actuation", rows=LOOPS)]
    channel = SteppedChannel(RunChannel(links, loops=LOOPS))
    now_ns, rng = 0, np.random.default_rng(1)
    sent: dict[tuple[int, int], bytes] = {}
    planned, left, inputs = Counter[tuple[int, ...]](), Counter[tuple[int, ...]](), list[int]()

    def release(until_ns: int) -> None:
        while (due_ns := channel.next_deadline_ns()) is not None and due_ns <= until_ns:
            ((flow, data),), ((_, number, sequence, t_ns, _, of_flow, copy, _),) = content_of(
                channel.on_timer(max(due_ns, now_ns))
            )
            assert (flow, t_ns) == (of_flow, due_ns)
            inputs.append(number)
            left[flow, sequence, copy, t_ns] += 1
            assert differing_bits(data, sent[flow, sequence]) <= 1

    for k, (flow, size, step_ns, leaves) in enumerate(arriving):
        if later is not None and k == len(arriving) // 2:
            channel.channel.change(later.model_copy(update={"first_delivered": first.first_delivered}))
        now_ns += step_ns
        if leaves:
            release(now_ns)
        data = rng.bytes(size)
        if k % 2 and size >= PACKET_HEAD_BYTES:  # an update with an error level
            data = b"NA\1\2\2" + data[5:]
        leaving, ((_, number, sequence, *_, release_ns, copy_ns, bit, size_bytes, head),) = content_of(
            channel.handle(Datagram(flow, data), now_ns)
        )
        inputs.append(number)
        sent[flow, sequence] = data
        assert (size_bytes, bytes(head)) == (size, data[:PACKET_HEAD_BYTES].ljust(PACKET_HEAD_BYTES, b"\0"))
        assert bit < 8 * size
        planned.update((flow, sequence, copy, t) for copy, t in enumerate((release_ns, copy_ns)) if t >= 0)
        for of_flow, of_data in leaving:
            assert of_flow == flow
            assert differing_bits(of_data, data) <= 1
        left.update((flow, sequence, copy, now_ns) for copy in range(len(leaving)))
    release(2**62)
    assert inputs == list(range(len(inputs)))
    packets = Counter(packet[:2] for packet in planned.elements())
    assert Counter(packet[:2] for packet in left.elements()) == packets
    chooses = any(settings.chooses for settings in (first, second, later or first))
    if not chooses:
        assert left == planned
    for link in links:
        counts = link.counters
        assert counts.received == sum(getattr(counts, fate.name.lower()) for fate in Fate)
        assert link.in_flight == 0
    assert sum(link.counters.forwarded for link in links) == left.total()


def differing_bits(data: bytes, other: bytes) -> int:
    assert len(data) == len(other)
    return (int.from_bytes(data, "little") ^ int.from_bytes(other, "little")).bit_count()


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
def test_numbers_of_no_network_are_refused() -> None:
    link = LinkState(LinkSettings(), 1, "update")
    for loops, links in ((0, [link]), (2, [link]), (65536, [link]), (1, []), (1, [link] * 3)):
        with pytest.raises(ValueError, match=r"channel: (a network has|a direction of)"):
            new_handle("channel", loops, len(links), [of.core for of in links], False)
