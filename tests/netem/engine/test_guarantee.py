"""At the receiver, at most M − 1 consecutive datagrams are missing, damaged or stale."""

import hashlib
from collections import defaultdict
from collections.abc import Sequence

from hypothesis import given, settings
from hypothesis import strategies as st

from noack.impairments.link_settings import LinkSettings
from tests.netem import any_settings
from tests.netem.engine.relays import drain, relayed

CLIENTS = 3


def sealed(number: int, side: str, size: int) -> bytes:
    """Return a payload with its number and a check of its integrity."""
    head = number.to_bytes(4, "big") + side.encode()
    body = head.ljust(size, b".")
    return hashlib.blake2b(body, digest_size=8).digest() + body


def number_of(payload: bytes) -> int | None:
    intact = hashlib.blake2b(payload[8:], digest_size=8).digest() == payload[:8]
    return int.from_bytes(payload[8:12], "big") if intact else None


def longest_loss_burst(received: Sequence[bytes], sent: int) -> int:
    """Return the most consecutive datagrams of ``sent`` that are missing, damaged or stale."""
    newest, longest = -1, 0
    for payload in received:
        number = number_of(payload)
        if number is not None and number > newest:
            longest = max(longest, number - newest - 1)
            newest = number
    return max(longest, sent - newest - 1)


@settings(max_examples=20)
@given(
    forward=any_settings.capped,
    reverse=any_settings.capped,
    rounds=st.lists(st.integers(1, 40), min_size=1, max_size=3),
    other=st.none() | any_settings.capped,
    segment=st.booleans(),
)
def test_the_cap_holds_in_both_directions_for_every_client(
    forward: LinkSettings,
    reverse: LinkSettings,
    rounds: list[int],
    other: LinkSettings | None,
    segment: bool,
) -> None:
    forward_cap = max(one.mansd or 0 for one in (forward, other or forward))
    reverse_cap = reverse.mansd or 0
    with relayed(forward, reverse, clients=CLIENTS, segment=segment) as (server, *clients, one):
        sent = 0
        for count in rounds:
            for number in range(sent, sent + count):
                for client in clients:
                    client.sendto(sealed(number, "there", 20 + number % 3), one.address())
            sent += count
            if other is not None:
                one.until(lambda: one.report().forward.counters.received > 0)
                one.relay.change("test", "forward", other)
                other = None
        one.settle(sent * CLIENTS)
        by_source = defaultdict(list)
        for payload, source in drain(server):
            by_source[source].append(payload)
        assert len(by_source) == CLIENTS
        for received in by_source.values():
            assert longest_loss_burst(received, sent) <= forward_cap
        for number in range(sent):
            for source in by_source:
                server.sendto(sealed(number, "reverse", 30), source)
        one.settle(sent * CLIENTS, "reverse")
        for client in clients:
            received = [payload for payload, _ in drain(client)]
            assert longest_loss_burst(received, sent) <= reverse_cap
        report = one.report()
    assert report.forward.counters.longest_loss_burst <= forward_cap
    assert report.reverse.counters.longest_loss_burst <= reverse_cap
    assert report.forward.unintended == report.reverse.unintended == {"lost_in_kernel": 0}
