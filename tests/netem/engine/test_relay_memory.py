"""The memory of a relay: table of clients, store of delayed datagrams."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from netem.relay_links import socket_name, unpacked_address
from netem.relay_memory import RelayMemory, name_array
from netem.tc_words import settings_of
from noack.core.core_library import core, pointer_to
from noack.runtime.address import packed_name
from tests.netem.engine.relays import HOSTS, drain, endpoints, link, name_of, running

ROWS, PLACES = 24, 32
hosts = st.sampled_from(["127.0.0.1", "10.1.2.3", "::1", "2001:db8::7", "fe80::1%lo"])
addresses = st.tuples(hosts, st.integers(1, 12))


@given(st.lists(st.tuples(st.booleans(), addresses, st.integers(0, 1)), max_size=200))
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


def test_memory_is_used_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of the datagrams are delayed or copied; clients appear and expire."""
    rounds, size, most_clients = 8, 300, 5
    monkeypatch.setattr("netem.relay._RARE_PERIOD_NS", 0)
    harsh = settings_of("loss 30% duplicate 30% delay 1ms 1ms mansd 3")
    with (
        endpoints(HOSTS[4]) as (server,),
        running([link(name_of(server), harsh, idle_s=0.001)]) as one,
    ):
        relay: Any = one.relay
        for number in range(rounds):
            with endpoints(*[HOSTS[4]] * most_clients) as clients:
                for client in clients * (size // most_clients):
                    client.sendto(bytes(600), one.address())
                one.settle((number + 1) * size)
                one.until(lambda: one.report().clients == 0)
            drain(server)
            memory = relay._memory
            assert memory.core.free_slots == memory.core.slot_count <= 4 * size
            assert memory.core.free_blocks == memory.core.block_count
            assert len(relay._clients._free_rows) == len(memory.clients)
            assert relay._clients._paths == {}
            assert relay._directions[0].rows == 16
