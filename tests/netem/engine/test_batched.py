"""Parts of the Linux engine only: client table, datagram store, cache of compiled code."""

import ctypes
import os
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from netem.engine.batched_engine import BatchedRelay
from netem.engine.compiled_rules import compile_rule
from netem.engine.pump.client_table import find, insert, key_of, remove
from netem.engine.pump.payload_store import drop, keep, pop, push
from netem.engine.pump_memory import PumpMemory
from netem.engine.relay_sockets import socket_name, unpacked_address
from netem.words.words_to_settings import settings_of
from noack.runtime.native.socket_structs import packed_name
from tests.netem.engine.relays import HOSTS, drain, endpoints, link, name_of, running

ROWS = 24
hosts = st.sampled_from(["127.0.0.1", "10.1.2.3", "::1", "2001:db8::7", "fe80::1%lo"])
addresses = st.tuples(hosts, st.integers(1, 12))


@pytest.mark.parametrize("host", ["127.0.0.1", "::1", "2001:db8::7", "fe80::1%lo"])
def test_socket_addresses_survive_encoding_and_decoding(host: str) -> None:
    name = socket_name((host, 4711), "test")
    packed, length = packed_name(name)
    assert length == (28 if ":" in host else 16)
    assert socket_name(unpacked_address(packed), "test") == name


@settings(max_examples=80)
@given(st.lists(st.tuples(st.booleans(), addresses, st.integers(0, 1)), max_size=200))
def test_the_table_of_clients_is_a_dictionary(
    steps: list[tuple[bool, tuple[str, int], int]],
) -> None:
    """A small table, so that many keys collide."""
    memory = PumpMemory(2, segment=False, taps=0).memory
    table = np.full(2 * ROWS, -1, np.int32)
    model: dict[tuple[tuple[str, int], int], int] = {}
    free = list(range(ROWS))
    do_find, do_key = compile_rule(find), compile_rule(key_of)
    for comes, address, number in steps:
        name = np.frombuffer(packed_name(socket_name(address, "test"))[0], np.int64)
        known = (address, number)
        assert do_find(table, memory.clients, *do_key(name, number)) == model.get(known, -1)
        if comes and known not in model and free:
            row = model[known] = free.pop()
            memory.clients["link"][row] = number
            compile_rule(insert)(table, memory.clients, row, name)
        elif not comes and known in model:
            compile_rule(remove)(table, memory.clients, model[known])
            free.append(model.pop(known))
    assert sorted(table[table >= 0].tolist()) == sorted(model.values())


@settings(max_examples=50)
@given(st.lists(st.integers(-3, 5), max_size=150), st.data())
def test_the_store_is_a_queue_by_time_and_arrival(steps: list[int], data: st.DataObject) -> None:
    """A negative step removes the first due entry; any other adds an entry with this due time."""
    holder = PumpMemory(1, segment=False, taps=0)
    free = (int(holder.pump["free_slots"]), int(holder.pump["free_blocks"]))
    do_keep, do_push = compile_rule(keep), compile_rule(push)
    do_pop, do_drop = compile_rule(pop), compile_rule(drop)
    model: list[tuple[int, int, int]] = []
    for number, step in enumerate(steps):
        if step >= 0:
            size = data.draw(st.sampled_from([0, 1, 512, 513, 3000]))
            payload = np.zeros(max(size, 1), np.uint8)
            slot = do_keep(holder.memory, payload.ctypes.data, size, -1)
            do_push(holder.memory, step, number, slot)
            model.append((step, number, slot))
        elif model:
            first = min(model)
            assert holder.memory.heap[0].tolist() == first
            do_pop(holder.memory)
            do_drop(holder.memory, first[2])
            model.remove(first)
    assert holder.pump["heap"] == len(model)
    for _, _, slot in model:
        do_drop(holder.memory, slot)
    assert (int(holder.pump["free_slots"]), int(holder.pump["free_blocks"])) == free


def test_the_timer_slack_of_the_thread_is_restored() -> None:
    def slack_ns() -> int:
        return int(ctypes.CDLL(None).prctl(30, 0, 0, 0, 0))

    before_ns, during_ns = slack_ns(), list[int]()
    with closing(BatchedRelay([link(("127.0.0.1", 9), settings_of("loss none"))])) as relay:
        relay.run(lambda: during_ns.append(slack_ns()) is None, lambda: None)
    assert (during_ns, slack_ns()) == ([1], before_ns)


def test_memory_is_used_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of the datagrams are delayed or copied; clients appear and expire."""
    rounds, size, most_clients = 8, 300, 5
    monkeypatch.setattr("netem.engine.batched_engine.RARE_PERIOD_NS", 0)
    harsh = settings_of("loss 30% duplicate 30% delay 1ms 1ms mansd 3")
    with (
        endpoints(HOSTS[4]) as (server,),
        running([link(name_of(server), harsh, idle_s=0.001)], "batched") as one,
    ):
        relay: Any = one.relay
        for number in range(rounds):
            with endpoints(*[HOSTS[4]] * most_clients) as clients:
                for client in clients * (size // most_clients):
                    client.sendto(bytes(600), one.address())
                one.settle((number + 1) * size)
                one.until(lambda: one.report().clients == 0)
            drain(server)
            memory, pump = relay._memory.memory, relay._memory.pump
            assert pump["free_slots"] == len(memory.slots) <= 4 * size
            assert pump["free_blocks"] == len(memory.block_next)
            assert len(relay._clients._free_rows) == len(memory.clients)
            assert relay._clients._paths == {}
            assert relay._directions[0].rows == 16


TINY_PUMP = """
def run_pump(memory, decisions, until_ns):
    return 0

def insert(table, clients, row, name):
    pass

def remove(table, clients, row):
    pass
"""
FIRST_START = """
import tiny_pump
from netem.engine import batched_clients, batched_engine, native_pump, relay_base
from netem.engine.pump import pump_loop
from netem.engine.engine_choice import open_relay
from netem.engine.relay_interface import LinkSpec
from noack.impairments.link_settings import LinkSettings
for module in (batched_clients, batched_engine, pump_loop):
    vars(module).update(vars(tiny_pump))  # it compiles faster
def checked(specs, open_links=relay_base.open_links):
    # A datagram to an open port would wait for the compilation.
    assert specs[0].name == "none" or native_pump.compiled_pump.cache_info().currsize
    return open_links(specs)
relay_base.open_links = checked
nothing = LinkSettings()
open_relay([LinkSpec("a", ("127.0.0.1", 0), ("127.0.0.1", 9), nothing, nothing)], "batched").close()
"""


def test_concurrent_first_starts_report_the_compilation_and_later_starts_do_not(
    tmp_path: Path,
) -> None:
    def start() -> subprocess.Popen[str]:
        paths = f"{Path(__file__).parents[3]}:{tmp_path}"
        return subprocess.Popen(
            [sys.executable, "-c", FIRST_START],
            env={"XDG_CACHE_HOME": str(tmp_path), "PATH": "/usr/bin:/bin", "PYTHONPATH": paths},
            stderr=subprocess.PIPE, text=True,
        )  # fmt: skip

    (tmp_path / "tiny_pump.py").write_text(TINY_PUMP)
    old, young = tmp_path / "noack" / "netem-0", tmp_path / "noack" / "netem-1"
    for folder in (old, young):
        folder.mkdir(parents=True)
        (folder / "run_pump.nbi").touch()
    os.utime(old, (0, 0))
    errors = [process.communicate(timeout=400)[1] for process in (start(), start())]
    line = "noack netem: compiling the relay for this machine, once; this takes about 15 s\n"
    assert errors == [line, line]
    assert start().communicate(timeout=400)[1] == ""
    assert not old.exists()
    assert young.exists()
