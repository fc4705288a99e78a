"""Parts of a relay: its links, its memory."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from netem.relay.link_sockets import socket_name
from netem.relay.relay_links import LinkSpec, open_links
from netem.relay.relay_memory import RelayMemory, name_array
from netem.tc_words import settings_of
from noack.core.core_library import core, pointer_to
from noack.core.errors import CallerError
from noack.runtime.address import packed_name, unpacked_address
from tests.netem.relay.relays import HOSTS, drain, endpoints, link, name_of, running


def open_and_close(specs: Sequence[LinkSpec]) -> None:
    for opened in open_links(specs):
        opened.close()


def free_port(host: str) -> int:
    with endpoints(host) as (endpoint,):
        return name_of(endpoint)[1]


@pytest.mark.parametrize(
    ("listen", "to"),
    [
        ("127.0.0.1", "127.0.0.1"), ("::1", "::1"), ("0.0.0.0", "127.0.0.1"),
        ("127.0.0.1", "0.0.0.0"), ("0.0.0.0", "127.1.2.3"), ("::", "::1"), ("::", "127.0.0.1"),
        ("::1", "::"),
    ],
)  # fmt: skip
def test_a_link_that_leads_back_to_itself_is_refused(listen: str, to: str) -> None:
    port = free_port(listen)
    with pytest.raises(CallerError, match=r"leads back to itself$"):
        open_and_close([link((to, port), listen=(listen, port))])


def test_a_link_to_the_same_port_of_another_address_is_allowed() -> None:
    for listen, to in (("127.0.0.1", "127.0.0.2"), ("0.0.0.0", "192.0.2.1")):
        port = free_port(listen)
        open_and_close([link((to, port), listen=(listen, port))])


def test_links_may_form_a_chain_but_not_a_cycle() -> None:
    ports = {name: free_port(HOSTS[4]) for name in "abc"}

    def chain(*names: str) -> list[LinkSpec]:
        return [
            link((HOSTS[4], ports[to]), listen=(HOSTS[4], ports[name]), name=name)
            for name, to in pairwise(names)
        ]

    open_and_close(chain("a", "b", "c"))
    with pytest.raises(CallerError, match=r"^link b: .* leads back to itself over c$"):
        open_and_close(chain("a", "b", "c", "b"))


def test_a_link_whose_address_cannot_be_used_is_refused() -> None:
    there = ("127.0.0.1", 9)
    with endpoints(HOSTS[4]) as (other,):
        for specs, message in (
            ([link(there, listen=("localhost", 0))], "not an address of IPv4 or IPv6"),
            ([link(there, listen=("192.0.2.1", 0))], "is no address of this machine"),
            ([link(("127.0.0.1", 0))], "^link test: to 127.0.0.1:0: port 0 is not a destination"),
            ([link(there, listen=name_of(other))], "already taken"),
            ([link(there)] * 2, "two links have this name"),
        ):
            with pytest.raises(CallerError, match=message):
                open_and_close(specs)


ROWS, PLACES = 24, 32
hosts = st.sampled_from(["127.0.0.1", "10.1.2.3", "::1", "2001:db8::7", "fe80::1%lo"])
addresses = st.tuples(hosts, st.integers(1, 12))


@given(st.lists(st.tuples(st.booleans(), addresses, st.integers(0, 1)), min_size=50, max_size=200))
def test_the_table_of_clients_is_a_dictionary(
    steps: list[tuple[bool, tuple[str, int], int]],
) -> None:
    """A small table, so that many keys collide."""
    memory = RelayMemory(2)
    table = np.full(PLACES, -1, np.int32)
    memory.core.table, memory.core.table_places = pointer_to(table, "int32_t *"), PLACES
    model: dict[tuple[tuple[str, int], int], int] = {}
    free = list(range(ROWS))
    for comes, address, number in steps:
        name = packed_name(socket_name(address, "test"))[0]
        assert socket_name(unpacked_address(name), "test") == socket_name(address, "test")
        known = (address, number)
        assert core.noack_client_find(memory.core, name, number) == model.get(known, -1)
        if comes and known not in model and free:
            row = model[known] = free.pop()
            memory.clients["link"][row] = number
            memory.clients["name"][row] = name_array(name)
            core.noack_client_insert(memory.core, row)
        elif not comes and known in model:
            core.noack_client_remove(memory.core, model[known])
            free.append(model.pop(known))
    assert sorted(table[table >= 0].tolist()) == sorted(model.values())


def test_the_relay_reuses_memory_of_datagrams_and_clients_that_left(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Half of the datagrams are delayed or copied; clients appear and expire."""
    rounds, size, most_clients = 8, 300, 5
    monkeypatch.setattr("netem.relay.relay._CHECK_PERIOD_NS", 0)
    harsh = settings_of("loss 30% duplicate 30% delay 1ms 1ms mansd 3")
    with (
        endpoints(HOSTS[4]) as (server,),
        running([link(name_of(server), harsh, idle_s=0.001)]) as emulator,
    ):
        relay: Any = emulator.relay
        for number in range(rounds):
            with endpoints(*[HOSTS[4]] * most_clients) as clients:
                for client in clients * (size // most_clients):
                    client.sendto(bytes(600), emulator.address())
                emulator.settle((number + 1) * size)
                emulator.until(lambda: emulator.report().clients == 0)
            drain(server)
            memory = relay._memory
            assert memory.core.free_slots == memory.core.slot_count <= 4 * size
            assert memory.core.free_blocks == memory.core.block_count
            assert len(relay._clients._free_rows) == len(memory.clients)
            assert relay._clients._paths == {}
            assert relay._directions[0].rows == 16
