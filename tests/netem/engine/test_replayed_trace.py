"""A trace replayed through real UDP: the receiver misses exactly the recorded packets.

By packet, losses do not depend on time, so that a machine that stalls changes nothing. The delays
are the same for all packets here, since a sender that stalls could otherwise change the order.
"""

from itertools import groupby
from pathlib import Path

import numpy as np
import pytest

from netem.tc_words import settings_of
from noack.impairments.loss_prediction import read_files
from noack.traces.packet_trace import PacketTrace
from noack.traces.trace_formats import read_trace
from tests.netem.engine.relays import HOSTS, drain, relayed

PACKETS = 400


def lossy_trace(path: Path) -> PacketTrace:
    """Write a trace with bursts of losses and with missing numbers; return it."""
    rng = np.random.default_rng(18)
    rows, lost = ["sequence,sent_ms,received_us"], False
    for number in range(PACKETS):
        lost = bool(rng.random() < (0.7 if lost else 0.1))
        if not lost:
            rows.append(f"{number},{2 * number},{2000 * number + 1500}")
        elif rng.random() < 0.5 or number in (0, PACKETS - 1):
            rows.append(f"{number},{2 * number},-1")
    path.write_text("\n".join(rows))
    return read_trace(path)


def bursts(lost: list[bool]) -> list[int]:
    return sorted(len(list(group)) for is_lost, group in groupby(lost) if is_lost)


@pytest.mark.parametrize("family", [4, 6])
def test_the_histogram_of_consecutive_losses_is_the_traces(family: int, tmp_path: Path) -> None:
    trace = lossy_trace(tmp_path / "trace.csv")
    forward = read_files(settings_of("replay trace.csv"), tmp_path)
    with relayed(forward, host=HOSTS[family]) as (server, client, one):
        for number in range(PACKETS):
            client.sendto(number.to_bytes(4, "big"), one.address())
            if number % 20 == 19:
                one.settle(number + 1)
        received = [int.from_bytes(data, "big") for data, _ in drain(server)]
        counters = one.report().forward.counters
    newest, effective = -1, set()
    for number in received:
        if number > newest:
            newest = number
            effective.add(number)
    found = [number not in effective for number in range(PACKETS)]
    assert bursts(found) == bursts(trace.lost.tolist())
    assert found == trace.lost.tolist()
    assert counters.dropped == trace.lost.sum() > 50
    assert max(bursts(found)) > 5
