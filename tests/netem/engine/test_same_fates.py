"""For any settings, the relay treats datagrams as the pure link machine decides."""

from collections import defaultdict
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from netem.relay_links import LinkSpec
from noack.impairments.link_settings import LinkSettings
from tests.netem import any_settings
from tests.netem.engine.relays import KeepAll, drain, name_of, relayed
from tests.oracles.link import Datagram, Link

CLIENTS = 3
DECIDED = ("packet", "fate", "consecutive_losses", "hold_back_ns", "bit", "copy_bit")


def replayed(
    spec: LinkSpec, side: int, events: NDArray[Any], payloads: list[bytes], began_ns: int
) -> dict[int, list[bytes]]:
    """Pass the arrivals to the machine, check its decisions; return the departures by flow."""
    own: LinkSettings = (spec.forward, spec.reverse)[side]
    machine = Link(own, spec.seed, spec.name, ("forward", "reverse")[side])
    left: dict[int, list[bytes]] = defaultdict(list)

    def take(outputs: Any) -> None:
        for output in outputs:
            if isinstance(output, Datagram):
                left[output.flow].append(output.data)

    def let_out(now_ns: float) -> None:
        while (due_ns := machine.next_deadline_ns()) is not None and due_ns <= now_ns:
            take(machine.on_timer(due_ns))

    for event, payload in zip(events, payloads, strict=True):
        if event["direction"] != side or event["departure"]:
            continue
        now_ns = int(event["t_ns"]) - began_ns
        let_out(now_ns)
        take(machine.handle(Datagram(int(event["flow"]), payload), now_ns))
        decision = machine.decision
        assert [event[field] for field in DECIDED] == [getattr(decision, f) for f in DECIDED]
        for field, t_ns in (("delay_ns", decision.release_ns), ("copy_delay_ns", decision.copy_ns)):
            assert event[field] == (-1 if t_ns < 0 else t_ns - now_ns)
    let_out(np.inf)
    return left


@settings(max_examples=15)
@given(
    forward=any_settings.harsh,
    reverse=any_settings.harsh,
    sizes=st.lists(st.sampled_from([0, 1, 8, 72, 1472, 9000]), min_size=20, max_size=60),
    segment=st.booleans(),
)
def test_fates_and_order_are_the_machines(
    forward: LinkSettings, reverse: LinkSettings, sizes: list[int], segment: bool
) -> None:
    tap = KeepAll()
    parts = relayed(forward, reverse, clients=CLIENTS, taps=[tap], segment=segment)
    with parts as (server, *clients, one):
        for k, size in enumerate(sizes):
            clients[k % CLIENTS].sendto(payload_of(k, size), one.address())
        one.settle(len(sizes))
        received = drain(server)
        for data, source in received:
            server.sendto(data, source)
        one.settle(len(received), "reverse")
        sides = one.report().forward, one.report().reverse
        (spec,) = one.relay.specs
        ports = [name_of(client)[1] for client in clients]
        at_clients = [[data for data, _ in drain(client)] for client in clients]
        events, began_ns = tap.events, one.relay.began_unix_ns
        assert began_ns is not None
    by_flow: dict[int, list[bytes]] = defaultdict(list)
    flow_of = {
        (bytes(event["source"][:4]), int(event["source_port"])): int(event["flow"])
        for event in events
        if event["departure"] and not event["direction"]
    }
    for data, (_, port) in received:
        by_flow[flow_of[b"\x7f\0\0\1", port]].append(data)
    assert by_flow == replayed(spec, 0, events, tap.payloads, began_ns)
    flow_at = {
        int(event["source_port"]): int(event["flow"])
        for event in events
        if not event["departure"] and not event["direction"]
    }
    expected = replayed(spec, 1, events, tap.payloads, began_ns)
    for port, found in zip(ports, at_clients, strict=True):
        assert found == expected.get(flow_at[port], [])
    departures = events[events["departure"] == 1]
    assert len(departures) == len(received) + sum(map(len, at_clients))
    # A stale datagram counts once; a copy counts if the original is corrupted.
    intact = departures[departures["bit"] < 0]
    counted = sum(one.counters.delivered_out_of_order for one in sides)
    assert intact["stale"][intact["copy"] == 0].sum() <= counted <= intact["stale"].sum()


def payload_of(number: int, size: int) -> bytes:
    return (number.to_bytes(8, "little") * (size // 8 + 1))[:size]
