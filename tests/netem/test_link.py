import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from netem.link import Datagram, Link, update_link_of
from noack.machine import Notice, Record
from noack.records import NETEM_PACKET, PACKET_HEAD_BYTES, Fate, tables
from noack.resolve import resolve
from noack.scenario import Bernoulli, GilbertElliott, Loss, WorstCase
from noack.scenario_file import validate

BERNOULLI = Bernoulli(model="bernoulli", probability=0.6)
BURSTS = GilbertElliott(model="gilbert_elliott", good_to_bad=0.3, bad_to_good=0.2)
ALL = WorstCase(model="worst_case")


def new_link(loss: Loss = BERNOULLI, mansd: int | None = 3, seed: int = 5, name: str = "a") -> Link:
    return Link(loss, mansd, seed, name)


def row_of(outputs: Sequence[Datagram | Record | Notice]) -> Any:
    (record,) = [output for output in outputs if isinstance(output, Record)]
    return np.array([record.row], tables(1, 1)[NETEM_PACKET])[0]


def fate_of(link: Link, flow: int, now_ns: int = 0) -> Fate:
    return Fate(row_of(link.handle(Datagram(flow, b""), now_ns))["fate"])


def fates(link: Link, flow: int, count: int) -> list[Fate]:
    return [fate_of(link, flow) for _ in range(count)]


@pytest.mark.parametrize("loss", [BERNOULLI, BURSTS, ALL], ids=lambda loss: loss.model)
@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 10**12)), max_size=60))
def test_a_flows_fates_depend_on_nothing_but_its_own_order(
    loss: Loss, arrivals: list[tuple[int, int]]
) -> None:
    """Whatever the other flows do, and whenever anything comes."""
    link = new_link(loss)
    found: dict[int, list[Fate]] = {flow: [] for flow in range(4)}
    for flow, now_ns in arrivals:
        found[flow].append(fate_of(link, flow, now_ns))
    for flow, seen in found.items():
        assert seen == fates(new_link(loss), flow, len(seen))


@pytest.mark.parametrize("loss", [BERNOULLI, BURSTS], ids=lambda loss: loss.model)
def test_every_seed_name_and_flow_has_a_stream_of_its_own(loss: Loss) -> None:
    sequences = [
        tuple(fates(new_link(loss, None, seed, name), flow, 200))
        for seed, name, flow in itertools.product((5, 6), ("a", "b"), (0, 1))
    ]
    assert len(set(sequences)) == 8
    again = tuple(fates(new_link(loss, None, 5, "a"), 0, 200))
    assert again == sequences[0]


def test_the_payload_decides_nothing() -> None:
    empty, full = new_link(), new_link()
    for k in range(200):
        one = row_of(empty.handle(Datagram(0, b""), 0))["fate"]
        other = row_of(full.handle(Datagram(0, bytes([k]) * k), 0))["fate"]
        assert one == other


@given(st.lists(st.binary(max_size=100), min_size=1, max_size=20))
def test_what_survives_is_forwarded_untouched_and_everything_is_recorded(data: list[bytes]) -> None:
    link = new_link(mansd=1)
    for k, payload in enumerate(data):
        message = Datagram(7, payload)
        outputs = link.handle(message, 1000 + k)
        row = row_of(outputs)
        dropped = row["fate"] == Fate.DROPPED
        forwarded = [output for output in outputs if not isinstance(output, Record)]
        assert forwarded == ([] if dropped else [message])
        assert (row["input"], row["sequence"], row["flow"]) == (k, k, 7)
        assert (row["t_ns"], row["now_ns"]) == (1000 + k, 1000 + k)
        assert row["size_bytes"] == len(payload)
        head = payload[:PACKET_HEAD_BYTES]
        assert row["head"].tobytes() == head + bytes(PACKET_HEAD_BYTES - len(head))


def test_packets_are_numbered_by_flow_and_drops_counted_by_flow() -> None:
    link = new_link(ALL, 2)
    found = [row_of(link.handle(Datagram(flow, b""), 0)) for flow in (0, 0, 1, 0, 1, 1, 0)]
    assert [row["input"] for row in found] == list(range(7))
    assert [row["sequence"] for row in found] == [0, 1, 0, 2, 1, 2, 3]
    assert [row["drop_run"] for row in found] == [0, 1, 0, 2, 1, 2, 0]
    forced = [row["fate"] == Fate.FORCED for row in found]
    assert forced == [True, False, True, False, False, False, True]


def test_a_link_has_nothing_of_its_own_to_do() -> None:
    link = new_link()
    link.handle(Datagram(0, b""), 0)
    assert link.next_deadline_ns() is None
    assert link.on_timer(10**9) == ()


@pytest.mark.parametrize(
    ("network", "expected"),
    [
        ({}, "FddFddF"),
        ({"initial_sync": "known_state"}, "ddFddFd"),
        ({"mansd": 0}, "FFFFFFF"),
        ({"enforce_mansd": False, "initial_sync": "known_state"}, "ddddddd"),
        ({"enforce_mansd": False}, "Fdddddd"),
    ],
)
def test_the_link_of_a_scenario_keeps_its_promise(
    content: dict[str, Any], network: dict[str, Any], expected: str
) -> None:
    content["network"] |= {"loss": {"model": "worst_case"}, **network}
    link = update_link_of(resolve(validate(content, "here")))
    found = "".join("dF"[fate is Fate.FORCED] for fate in fates(link, 0, 7))
    assert found == expected


def test_the_seed_of_the_losses_is_the_scenarios_own(content: dict[str, Any]) -> None:
    def found(**seeds: int) -> list[Fate]:
        content["seeds"] = seeds
        return fates(update_link_of(resolve(validate(content, "here"))), 0, 100)

    assert found(loss=1) == found(loss=1, plant=9, initial_state=9)
    assert found(loss=1) != found(loss=2)
