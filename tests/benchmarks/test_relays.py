"""The load generator and the relays: counts only, no rates; and the figures made of them."""

import shutil
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from benchmarks import relay_load, relays
from benchmarks.relay_load import (
    Built,
    Burst,
    Ends,
    Kind,
    Sides,
    built,
    c_relay,
    figures_of,
    new_soak,
    our_relay,
    running,
    socat,
    sources,
)
from benchmarks.report import MeasurementError

needs_compiler = pytest.mark.skipif(
    sys.platform != "linux" or shutil.which("cc") is None, reason="the load is Linux's, and in C"
)


@pytest.fixture(scope="module")
def tools() -> Iterator[Built]:
    with built() as found:
        yield found


@pytest.fixture
def ends(tools: Built) -> Iterator[Ends]:
    pair = Ends(tools.load)
    pair.connect(pair.sink_port)
    yield pair
    pair.close()


@needs_compiler
def test_a_burst_is_numbered_and_uses_all_source_addresses_in_turn(ends: Ends) -> None:
    """It stops and continues the process that it measures."""
    with (
        subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mine,
    ):
        found = ends.burst(process.pid, 100)
        assert (found.decided, found.received) == (100, 100)
        mine.bind(("127.0.0.1", 0))
        mine.setblocking(False)
        ends.connect(mine.getsockname()[1])
        found = ends.burst(process.pid, 130, addresses=sources(100))
        process.kill()
        assert (found.decided, found.received) == (0, 0)
        taken = [mine.recvfrom(2048) for _ in range(130)]
    assert [int.from_bytes(data[:8], sys.byteorder) for data, _ in taken] == [*range(100, 230)]
    assert {len(data) for data, _ in taken} == {72}
    assert [host for _, (host, _) in taken] == [f"127.1.0.{k % 100}" for k in range(130)]


@needs_compiler
def test_all_send_methods_continue_the_numbering(
    ends: Ends, monkeypatch: pytest.MonkeyPatch
) -> None:
    found, cpu_s = ends.direct(150)
    assert (found.decided, found.received) == (150, 150)
    assert cpu_s > 0
    assert (ends.ping(20) > 0).all()
    assert (ends.pace(20, 10_000) > 0).all()
    assert ends.sent == 190
    state = new_soak()
    for count in (70, 70, 70, 0):
        ends.soak(state, 5, count, 1000)
    assert (state.sent, state.received, state.longest_gap) == (1050, 1050, 0)
    monkeypatch.setattr(relay_load, "_PATIENCE_NS", 1_000_000)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mine:  # which does not reply
        mine.bind(("127.0.0.1", 0))
        ends.connect(mine.getsockname()[1])
        assert (ends.ping(2) == -1).all()
        assert (ends.pace(2, 10_000) == -1).all()


@needs_compiler
def test_gaps_and_disorder_of_a_steady_load_are_counted(ends: Ends) -> None:
    state = new_soak()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mine:
        for number in (0, 1, 5, 6, 4, 9):  # 2 and 3 are missing, 4 is late, 7 and 8 are missing
            mine.sendto(number.to_bytes(8, sys.byteorder), ("127.0.0.1", ends.sink_port))
    ends.soak(state, 1, 0, 1000)
    assert (state.received, state.disordered, state.longest_gap) == (6, 1, 3)
    assert (state.next, state.sent) == (10, 0)


PEERS: dict[str, Callable[[Built], Kind | str]] = {
    "C relay": c_relay,
    "C relay, segments": lambda tools: c_relay(tools, "segment"),
    "C relay, a socket per client": lambda tools: c_relay(tools, "paths"),
    "socat": lambda tools: socat(),
}


@needs_compiler
@pytest.mark.parametrize("name", PEERS)
def test_a_peer_forwards_everything_in_order(name: str, tools: Built) -> None:
    kind = PEERS[name](tools)
    if isinstance(kind, str):
        pytest.skip(kind)
    assert kind.name == name
    with running(kind, tools) as relay:
        assert relay.burst()["cpu_us"] > 0  # an incomplete burst raises
        assert (relay.ends.ping(20) > 0).all()


@needs_compiler
def test_the_relays_counters_agree_with_sender_and_sink(tools: Built) -> None:
    with running(our_relay("ours", "loss 30% mansd 2 seed 3"), tools) as relay:
        found = relay.ends.burst(relay.pid, 200, slack=2)
        totals = relay.totals()
    assert totals.arrived == 200
    assert totals.forwarded == found.received < 200
    assert totals.longest_loss_burst <= 2
    assert totals.lost_in_kernel == 0
    assert 198 <= found.decided <= 200


@needs_compiler
def test_a_relay_that_does_not_start_or_fails_is_reported_and_omitted(tools: Built) -> None:
    kinds: list[tuple[str, Kind | str]] = [
        ("absent", "not installed"),
        ("broken", Kind("broken", lambda *_: [sys.executable, "-c", "exit('no reason')"])),
        ("C relay", c_relay(tools)),
    ]
    with Sides(kinds, tools) as sides:
        missing = sides.rounds.missing
        assert missing["absent"] == "not installed"
        assert "said 'no reason'" in missing["broken"]
        sides.in_turn(lambda relay: {relay.name: {"pid": relay.pid}})

        def fail(relay: object) -> dict[str, dict[str, float]]:
            raise MeasurementError("lost")

        sides.in_turn(fail)
        assert sides.relays == []
    assert missing["C relay"] == "lost"
    assert len(sides.rounds.of("C relay", "pid")) == 1


def test_without_a_compiler_there_is_one_clear_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda program: None)
    with pytest.raises(MeasurementError, match="cc is not installed"), built():
        pass
    assert isinstance(socat(), str)


def test_an_incomplete_burst_or_delay_gives_no_figure() -> None:
    """The rate counts decided and not forwarded packets; the base delay is subtracted."""
    figures = figures_of("ours", Burst(wall_s=0.01, decided=998, received=950), 1000, 16, 0.003)
    assert figures == pytest.approx({"per_s": 99_800, "cpu_us": 3.0})
    for burst, slack in ((Burst(0.01, 983, 930), 16), (Burst(0.01, 1000, 999), 0)):
        with pytest.raises(MeasurementError, match=f"only {burst.received} arrived"):
            figures_of("relay", burst, 1000, slack, 0.003)
    delays_ns = np.arange(1, 102) * 1000  # 1, 2, ..., 101 µs
    assert relays.quantiles_of("relay", delays_ns, 3.0) == {"p50": 48.0, "p99": 97.0}
    with pytest.raises(MeasurementError, match="relay: 2 of 3 datagrams did not arrive"):
        relays.quantiles_of("relay", np.array([-1, 5, -1]))
