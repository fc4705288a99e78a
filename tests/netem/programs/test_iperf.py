"""iperf3's report on a stream agrees with the emulator's record."""

import asyncio
import shutil
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import pytest

from noack.protocol.record_tables import Fate
from tests.netem.programs.conftest import Emulate
from tests.netem.programs.emulator import Emulator
from tests.netem.programs.iperf import (
    Measured,
    counted,
    forward_tcp,
    iperf_client,
    iperf_server,
)
from tests.netem.programs.ports import HOST, open_server

pytestmark = pytest.mark.skipif(shutil.which("iperf3") is None, reason="iperf3 is not installed")

SIZE = ("--length", "200")
STREAMS = 2
ATTEMPTS = 3
"""Attempts to measure a jitter, because a stall of the machine adds jitter."""


class Ran(NamedTuple):
    iperf: Measured
    emulator: Emulator
    link: dict[str, Any]


def run(emulate: Emulate, words: Sequence[str], *options: str) -> Ran:
    async def go() -> tuple[Measured, Emulator]:
        server, there = await open_server(iperf_server)
        try:
            while True:
                emulator = emulate(f"{HOST}:{there}", *words)
                try:
                    forwarder = await forward_tcp(emulator.port, there)
                    break
                except OSError:  # the port is free for UDP only
                    emulator.finish()
            async with forwarder:
                return await iperf_client(emulator.port, *options), emulator
        finally:
            if server.returncode is None:
                server.kill()
            await server.communicate()

    measured, emulator = asyncio.run(go())
    return Ran(measured, emulator, emulator.finish())


def test_iperf3_counts_the_emulators_drops_as_lost(emulate: Emulate) -> None:
    # The first datagram of a stream opens it, and iperf3 does not repeat it.
    words = ("--both", "loss 10% mansd 3 first")
    options = (*SIZE, "--bitrate", "1M", "--time", "1", "--parallel", str(STREAMS))
    ran = run(emulate, words, *options, "--reverse")
    of = ran.link["reverse"]
    assert of["longest_loss_burst"] <= 3
    assert of["fates"]["dropped"] == of["received"] - of["forwarded"] > 0
    dropped_of_all = 0
    for stream, connected in enumerate(ran.iperf.client["start"]["connected"]):
        assert of["flows"][stream]["client"] == f"{HOST}:{connected['local_port']}"
        fates = [row["fate"] for row in ran.emulator.fates("reverse", flow=stream)]
        counts = ran.iperf.counts(stream, reverse=True)
        # iperf3's receiver stops at the end message over TCP and may leave datagrams unread.
        assert len(fates) / 2 < counts.newest < len(fates)
        assert fates[0] != Fate.DROPPED
        assert fates[counts.newest] != Fate.DROPPED
        assert counts.lost == fates[: counts.newest].count(Fate.DROPPED) > 0
        assert counts.out_of_order == 0
        dropped_of_all += fates.count(Fate.DROPPED)
    assert dropped_of_all == of["fates"]["dropped"]


def test_iperf3_reports_the_packet_order_of_the_emulator(emulate: Emulate) -> None:
    words = ("--both", "delay 10ms reorder 20% loss 5% duplicate 3% mansd 5 first")
    ran = run(emulate, words, *SIZE, "--bitrate", "1M", "--time", "1")
    of = ran.link["forward"]
    assert of["longest_loss_burst"] <= 5
    assert of["delivered_out_of_order"] > 50
    departures = ran.emulator.departures("forward")
    delivered_out_of_order = copies = newest = 0
    for departure in departures:
        delivered_out_of_order += departure.packet < newest
        copies += departure.packet == newest > 0
        newest = max(newest, departure.packet)
    assert (
        of["delivered_out_of_order"]
        <= delivered_out_of_order
        <= of["delivered_out_of_order"] + of["duplicated"]
    )
    assert of["duplicated"] > 0
    counts = ran.iperf.counts(0, reverse=False)
    states = list(counted(departures))
    assert counts in states[len(states) // 2 :]
    assert counts.out_of_order > 50


def test_iperf3_measures_the_jitter_of_the_emulator(emulate: Emulate) -> None:
    for _ in range(ATTEMPTS):
        ran = run(emulate, ["delay 20ms 5ms"], *SIZE, "--bitrate", "160k", "--time", "1")
        departures = ran.emulator.departures("forward")
        read = list(counted(departures)).index(ran.iperf.counts(0, reverse=False)) + 1
        # RFC 3550, A.8, for the decided delays; iperf3's own processing times add to them.
        jitter_ns = 0.0
        for before, after in pairwise(departures[1:read]):
            jitter_ns += (abs(after.delay_ns - before.delay_ns) - jitter_ns) / 16
        assert jitter_ns > 1e6
        reported_ms = ran.iperf.server["end"]["streams"][0]["udp"]["jitter_ms"]
        if abs(reported_ms * 1e6 - jitter_ns) <= 0.1 * jitter_ns:
            return
    pytest.fail(f"{ATTEMPTS} times another jitter: {reported_ms} ms instead of {jitter_ns / 1e6}")
