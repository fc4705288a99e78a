"""Parts of the Linux engine only: client table, datagram store, cache of compiled code."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from netem.engine.compiled_rules import compile_rule
from netem.engine.pump.client_table import find, insert, key_of, remove
from netem.engine.pump.payload_store import drop, keep, pop, push
from netem.engine.pump_memory import PumpMemory
from netem.engine.relay_sockets import place_of
from netem.engine.socket_names import address_of_name, name_of
from noack.impairments.kinds.delay import Delay
from noack.impairments.kinds.duplicate import Duplicate
from noack.impairments.kinds.loss import LossOf
from noack.impairments.link_settings import LinkSettings
from noack.impairments.loss_models.bernoulli import BernoulliLoss
from tests.netem.engine.relays import HOSTS, drain, endpoints, link, running
from tests.netem.engine.relays import name_of as bound_name

ROWS = 24
hosts = st.sampled_from(["127.0.0.1", "10.1.2.3", "::1", "2001:db8::7", "fe80::1%lo"])
addresses = st.tuples(hosts, st.integers(1, 12))


@pytest.mark.parametrize("host", ["127.0.0.1", "::1", "2001:db8::7", "fe80::1%lo"])
def test_socket_addresses_survive_encoding_and_decoding(host: str) -> None:
    name, length = name_of(place_of((host, 4711), "test"))
    assert length == (28 if ":" in host else 16)
    found, port = address_of_name(name)
    assert place_of((found, port), "test") == place_of((host, 4711), "test")


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
        name = np.frombuffer(name_of(place_of(address, "test"))[0], np.int64)
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


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def test_memory_stays_flat_over_a_million_datagrams() -> None:
    """Half of the datagrams are delayed or copied; clients appear and expire."""
    rounds, size = 100, 10_000
    harsh = LinkSettings(
        impairments=(
            LossOf(loss=BernoulliLoss(probability=0.3)),
            Duplicate(probability=0.3),
            Delay(delay_s=0.001, jitter_s=0.001),
        ),
        mansd=3,
    )
    with (
        endpoints(HOSTS[4]) as (server,),
        running([link(bound_name(server), harsh, idle_s=0.02)], "batched") as one,
    ):
        there, early = one.relay.addresses()["test"], 0
        for number in range(rounds):
            with endpoints(HOSTS[4]) as (client,):
                for _ in range(size):
                    client.sendto(b"x" * 64, there)
                arrived = (number + 1) * size
                one.until(lambda arrived=arrived: handled(one.relay.report()[0]) >= arrived)
            drain(server)
            if number == rounds // 5:
                early = resident_bytes()
        assert resident_bytes() - early < 4 * 1024 * 1024


def handled(report: object) -> int:
    forward = report.forward  # type: ignore[attr-defined]
    return int(forward.counters.received + forward.unintended["lost_in_kernel"])


FIRST_START = """
import socket
from netem.engine import batched_engine
from netem.engine.relay_interface import LinkSpec
from netem.engine.engine_choice import open_relay
from noack.impairments.link_settings import LinkSettings
def checked(specs, bind=batched_engine.open_links):
    # What came to an open port would wait until all is compiled.
    assert specs[0].name == "none" or batched_engine.functions().run_pump.signatures
    return bind(specs)
batched_engine.open_links = checked
server = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
server.bind(("127.0.0.1", 0))
server.setblocking(False)
nothing = LinkSettings()
spec = LinkSpec("a", ("127.0.0.1", 0), server.getsockname(), nothing, nothing)
relay = open_relay([spec], "batched")
server.sendto(b"x", relay.addresses()["a"])
relay.run(lambda: relay.report()[0].forward.counters.forwarded == 1, lambda: None)
assert server.recv(10) == b"x"
relay.close()
"""


def test_concurrent_first_starts_report_the_compilation_and_later_starts_do_not(
    tmp_path: Path,
) -> None:
    def start() -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-c", FIRST_START],
            env={"XDG_CACHE_HOME": str(tmp_path), "PATH": "/usr/bin:/bin"},
            cwd=Path(__file__).parents[3],
            stderr=subprocess.PIPE,
            text=True,
        )

    old, young = tmp_path / "noack" / "netem-0", tmp_path / "noack" / "netem-1"
    for folder in (old, young):
        folder.mkdir(parents=True)
        (folder / "run_pump.nbi").touch()
    os.utime(old, (0, 0))
    said = [process.communicate(timeout=400)[1] for process in (start(), start())]
    line = "noack netem: compiling the relay for this machine, once; this takes about 15 s\n"
    assert said == [line, line]
    assert start().communicate(timeout=400)[1] == ""
    assert not old.exists()
    assert young.exists()
