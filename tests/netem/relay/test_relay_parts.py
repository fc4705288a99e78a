"""Parts of a relay: its links, its memory."""

import ast
import os
import socket
import struct
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from netem.core.address import packed_name, unpacked_address
from netem.core.core_library import core, ffi, pointer_to
from netem.core.errors import CallerError
from netem.impairments.link_settings import LinkSettings
from netem.relay.link_sockets import socket_name
from netem.relay.relay import Relay
from netem.relay.relay_links import DeviceLink, LinkSpec, open_links
from netem.relay.relay_memory import RelayMemory, name_array
from netem.tc_words import settings_of
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
            (
                [link(there, listen=("192.0.2.1", 0))],
                ":0: 192.0.2.1 is no address of this machine; see `ip address`$",
            ),
            ([link(("127.0.0.1", 0))], "^link test: to 127.0.0.1:0: port 0 is not a destination"),
            ([link(there, listen=name_of(other))], "already taken"),
            ([link(there)] * 2, "two links have this name"),
        ):
            with pytest.raises(CallerError, match=message):
                open_and_close(specs)


def test_settings_that_the_core_refuses_are_a_mistake_of_the_caller() -> None:
    """Whatever limits the core has: the relay stays as it was."""
    many = settings_of("loss 5%").impairments * 1025
    wrong = LinkSettings().model_copy(update={"impairments": many})
    message = "^link test forward: link: there are more than 1024 stages"
    with pytest.raises(CallerError, match=message):
        Relay([link(("127.0.0.1", 9), wrong)])
    with closing(Relay([link(("127.0.0.1", 9), settings_of("mansd 2"))])) as relay:
        with pytest.raises(CallerError, match=message):
            relay.change("test", "forward", wrong)
        assert relay.report()[0].forward.settings == settings_of("mansd 2")


ROWS, PLACES = 24, 32
hosts = st.sampled_from(["127.0.0.1", "10.1.2.3", "::1", "2001:db8::7", "fe80::1%lo"])
addresses = st.tuples(hosts, st.integers(1, 12))


@given(st.lists(st.tuples(st.booleans(), addresses, st.integers(0, 1)), min_size=50, max_size=200))
def test_the_table_of_clients_is_a_dictionary(
    steps: list[tuple[bool, tuple[str, int], int]],
) -> None:
    """A small table, so that many keys collide."""
    memory = RelayMemory(2)
    memory.core.table_places = PLACES
    table = np.frombuffer(ffi.buffer(memory.core.table, 4 * PLACES), np.int32)
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


def hashed(key: NDArray[np.int64], secret: tuple[int, int] = (0, 0)) -> int:
    secrets = np.array(secret, np.uint64)
    return int(core.noack_client_hash(pointer_to(secrets, "uint64_t *"), pointer_to(key, "int64_t *")))


def test_the_hash_of_clients_is_that_of_python() -> None:
    """With the seed 0, Python's key of SipHash-1-3 is 0."""
    if sys.hash_info.algorithm != "siphash13":
        pytest.skip(f"this Python has {sys.hash_info.algorithm}")
    keys = np.random.default_rng(1).integers(-(2**63), 2**63 - 1, (20, 5))
    code = f"print([hash(bytes.fromhex(key)) for key in {[key.tobytes().hex() for key in keys]}])"
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | {"PYTHONHASHSEED": "0"},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert [value % 2**64 for value in ast.literal_eval(done.stdout)] == [hashed(key) for key in keys]
    assert hashed(keys[0], (1, 0)) != hashed(keys[0]) != hashed(keys[0], (0, 1))


def _of_one_place(count: int, places: int) -> NDArray[np.uint32]:
    """Return chosen hosts of IPv4 that had one place by the former hash, which had no secret key."""
    hosts = np.arange(1, 1 + count * places * 2, dtype=np.uint64)
    mixed = np.zeros(len(hosts), np.uint64)
    for word in ((hosts << np.uint64(32)) | np.uint64(0x100_0002), *[np.zeros_like(hosts)] * 4):
        mixed = (mixed ^ word) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(29)
    return hosts[mixed % np.uint64(places) == 0][:count].astype(np.uint32)


def test_chosen_addresses_do_not_meet_in_the_table_of_clients() -> None:
    tables = list[NDArray[np.bool_]]()
    chosen = _of_one_place(60, 256)
    assert len(chosen) == 60
    for _ in range(2):
        memory = RelayMemory(1)
        assert memory.core.table_places == 256
        table = np.frombuffer(ffi.buffer(memory.core.table, 4 * 256), np.int32)
        for row, host in enumerate(chosen):
            name = struct.pack("<HHI24x", socket.AF_INET, 0x100, host)
            memory.clients["name"][row, : len(name)] = np.frombuffer(name, np.uint8)
            core.noack_client_insert(memory.core, row)
        assert not np.any(np.convolve(table >= 0, np.ones(40), "valid") == 40)  # no run of 40 places
        tables.append(table >= 0)
    assert (tables[0] != tables[1]).any()  # each has its own secret


def test_a_flood_from_outside_leaves_room_for_flows_that_begin_inside(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    most = 8
    pairs = [socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM) for _ in range(2)]
    monkeypatch.setattr(DeviceLink, "device_name", lambda *_: "lo")
    for pair in pairs:
        for end in pair:
            end.setblocking(False)
    (inside, inner), (outside, outer) = pairs
    counts = tuple(os.open("/proc/self/net/dev", os.O_RDONLY) for _ in range(2))
    spec = LinkSpec("shell", ("198.18.0.2", 0), ("198.18.0.1", 0), LinkSettings(), LinkSettings())
    spec = replace(spec, most_clients=most)
    devices = (os.dup(inner.fileno()), os.dup(outer.fileno()))
    link = DeviceLink(spec, devices, (counts[0], counts[1]), os.open("/dev/null", 0), None)

    def send(end: socket.socket, first: int, ports: int) -> None:
        for port in range(first, first + ports):
            ends = (
                bytes((198, 18, 0, 2, 198, 18, 0, 1))
                if end is inside
                else bytes((198, 18, 0, 1, 198, 18, 0, 2))
            )
            header = bytes((0x45, 0, 0, 28, 0, 0, 0, 0, 64, 17, 0, 0)) + ends
            end.send(header + struct.pack("!HHHH", port, 9, 8, 0))

    def received(end: socket.socket) -> int:
        count = 0
        with suppress(BlockingIOError):
            while end.recv(2000):
                count += 1
        return count

    passed = list[int]()
    steps: list[Callable[[], object]] = [
        lambda: send(outside, 1000, 20),
        lambda: passed.append(received(inside)),
        lambda: send(inside, 2000, 3),
        lambda: send(inside, 2000, 2 * most),
        lambda: passed.append(received(outside)),
    ]
    relay = Relay([spec], devices=link)
    try:
        relay.run(lambda: not steps, lambda: steps.pop(0)())
        assert passed == [most // 2, 3 + most // 2]
        assert relay.report()[0].refused == 20 - most // 2 + 2 * most - most // 2
    finally:
        relay.close()
        for pair in pairs:
            for end in pair:
                end.close()
    said = capsys.readouterr().err
    assert "a flood from outside: other hosts have begun 4 flows" in said
