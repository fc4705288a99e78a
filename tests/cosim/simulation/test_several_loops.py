"""Several loops on one network in virtual time, against the same loops alone and the link's law."""

from typing import Any

import numpy as np
import pytest

from cosim.analysis.replay import replay
from cosim.analysis.replay.machine_replay import SharedMachines
from cosim.analysis.replay.run_replay import replay_run
from cosim.record.run_record import RecordedRun, RunRecord
from cosim.simulation.virtual_time import simulate, simulate_loops
from netem.core.packet_rows import NETEM_PACKET, NETEM_RELEASE, Fate
from noack.protocol.record_tables import SENSOR_MEASUREMENT
from noack.protocol.wire_format import HEADER_ROW, datagram_bytes
from noack.scenario.resolution import resolve, resolve_run
from noack.scenario.scenario_file import validate
from tests.cosim.record.changed_records import changed

Content = dict[str, Any]
UDP_AND_IP_BYTES = 28


def require_same_rows(alone: RunRecord, record: RunRecord) -> None:
    """Compare all rows; the heads of the packets have the loop's number."""
    for table in alone.tables:
        for name in alone[table].dtype.names or ():
            if name != "head":
                assert alone[table][name].tobytes() == record[table][name].tobytes(), (table, name)


@pytest.fixture
def short(content: Content) -> Content:
    """Two seconds at 100 Hz, with plants that are drawn and disturbed at random."""
    content["horizon_s"] = 2.0
    content["plant"] |= {
        "rate_hz": 100.0,
        "draw": "uniform", "uncertainty_A": [[0.0, 0.0], [0.5, 0.5]],
        "initial_state_halfwidth": [0.5, 0.5],
        "disturbances": [{"kind": "uniform", "bound": [0.5]}],
    }  # fmt: skip
    content["controller"] = {"rate_hz": 100.0}
    content["trigger"]["beta"] = 0.01
    return content


def run(content: Content, *loops: Content) -> RecordedRun:
    return simulate_loops(resolve_run(validate(content | {"loops": list(loops)}, "here")))


@pytest.mark.parametrize("protocol", ["none", "ack"])
@pytest.mark.parametrize(
    "delay",
    [[], pytest.param([{"kind": "delay", "delay_s": 0.012, "jitter_s": 0.009}], marks=pytest.mark.sanitized)],
)
def test_the_first_loop_is_the_run_without_loops(short: Content, protocol: str, delay: list[Content]) -> None:
    """Losses and delays are drawn per flow: other loops do not change the first."""
    short["network"] |= {"protocol": protocol, "impairments": delay}
    alone = simulate(resolve(validate(short, "here")))
    assert len(alone[NETEM_PACKET]) > 10
    only = run(short, {"name": "only"}).record(0)
    assert all(only[t].tobytes() == alone[t].tobytes() for t in alone.tables)
    assert (only.notices, only.reports) == (alone.notices, alone.reports)
    if protocol == "none":  # the flow of an acknowledgement has another number among four loops
        require_same_rows(alone, run(short, {"name": "a", "count": 4}).record(0))


@pytest.fixture
def crowded(short: Content) -> Content:
    """20 loops send more than twice what the bottleneck carries."""
    size_bits = 8 * (datagram_bytes(2) + UDP_AND_IP_BYTES)
    rate_bps = 20 * 20 * size_bits * 2 // 5
    short["network"] |= {
        "mansd": 3,
        "loss": {"model": "bernoulli", "probability": 0.1},
        "impairments": [{"kind": "rate", "rate_bps": rate_bps, "queue": 5}],
    }
    short["trigger"] = {"policy": "periodic", "period_s": 0.05}
    return short


@pytest.mark.sanitized
def test_the_guarantee_holds_per_loop_when_the_shared_queue_overflows(crowded: Content) -> None:
    """All packets leave one after the other: the gaps are at least their transmission time."""
    shared = run(crowded, {"name": "a", "count": 20})
    fates = shared.network[NETEM_PACKET]["fate"]
    assert (fates == Fate.OVERFLOWED).sum() > 100
    assert (fates == Fate.FORCED).sum() > 10
    longest = []
    for loop_record in shared.loops:
        lost = ~np.isin(loop_record[NETEM_PACKET]["fate"], (Fate.DELIVERED, Fate.FORCED))
        runs = np.diff(np.flatnonzero(np.diff(np.concatenate([[0], lost, [0]]))))[::2]
        longest.append(int(runs.max(initial=0)))
    assert max(longest) == 3
    left_ns = np.sort(shared.network[NETEM_RELEASE]["t_ns"])
    (rate,) = crowded["network"]["impairments"]
    gap_ns = 8 * (datagram_bytes(2) + UDP_AND_IP_BYTES) * 10**9 // rate["rate_bps"]
    gaps_ns = np.diff(left_ns)
    assert len(left_ns) > 200
    assert gaps_ns.min() >= gap_ns
    # The link is loaded above its rate: it is hardly ever idle.
    assert (gaps_ns <= gap_ns + 1).mean() > 0.95


def test_a_single_loop_with_a_phase_replays_with_the_network_in_the_time_of_the_run(short: Content) -> None:
    """The slots of a schedule are those of the run; the loop's own time begins at its phase."""
    short["network"]["impairments"] = [{"kind": "schedule", "order": [0, -1], "slot_s": 0.0029}]
    only = run(short, {"name": "only", "phase": 0.3})
    result = replay_run(only)
    assert (result.bit_exact, result.gaps) == (True, [])
    assert {process.process for process in result.processes} == {"plant", "sensor", "netem", "controller"}
    assert (only.record(0)[NETEM_PACKET]["release_ns"] % 5_800_000 != 0).all()


@pytest.mark.sanitized
def test_a_replay_is_exact_and_finds_a_changed_bit(crowded: Content) -> None:
    shared = run(crowded, {"name": "a", "count": 3}, {"name": "b", "mode": "zoh"})
    result = replay(shared.network)
    assert (result.bit_exact, result.gaps, len(result.processes)) == (True, [], 1)
    machines = SharedMachines([*shared.loops])
    for record in shared.loops:
        result = replay(record, machines)
        assert result == replay(record)
        assert (result.bit_exact, result.gaps, len(result.processes)) == (True, [], 3)
        assert all(hop.compared > 20 for hop in result.messages)
    packets = shared.network[NETEM_PACKET].copy()
    packets["release_ns"][-1] += 1
    assert replay(changed(shared.network, {NETEM_PACKET: packets})).bit_exact is False
    packets = shared.record(2)[NETEM_PACKET].copy()
    head = bytearray(packets["head"][3].tobytes())
    head[6] = 1  # the number of another loop
    packets["head"][3] = bytes(head)
    other = changed(shared.record(2), {NETEM_PACKET: packets})
    result = replay(other)
    assert result == replay(other, SharedMachines([*shared.read(range(2)), other]))
    assert result.first_difference is not None
    assert result.first_difference.column == "head"


@pytest.mark.sanitized
def test_loops_of_different_sizes_replay_each_on_its_own(crowded: Content) -> None:
    oscillator = {
        "name": "oscillator",
        "model": {"A": [[0.0, 1.0, 0.0], [-1.0, -0.1, 0.0], [0.0, 0.0, -1.0]],
                  "B": [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]],
                  "gain": [[-1.0, -1.0, 0.0], [0.0, 0.0, -1.0]]},
        "plant": {"initial_state": [0.1, 0.0, 0.1], "initial_state_halfwidth": [0.0] * 3,
                  "uncertainty_A": [[0.0] * 3] * 3, "uncertainty_B": [[0.0] * 2] * 3,
                  "disturbances": []},
    }  # fmt: skip
    shared = run(crowded, {"name": "a", "count": 3}, oscillator)
    assert [record["plant_step"]["x"].shape[1] for record in shared.loops] == [2, 2, 2, 3]
    assert all(replay(record).bit_exact for record in (shared.network, *shared.loops))


def shares_of(level: int) -> tuple[float, float]:
    """Return the shares of the threshold for which an error level stands, by docs/wire.md.

    Level 128 + 16 k + j stands for shares from 2^k (1 + j/16) to the next one; 1 also for smaller
    ones, 255 also for larger ones.
    """
    least, following = (2.0 ** (k // 16 - 8) * (1 + k % 16 / 16) for k in (level, level + 1))
    return 0.0 if level == 1 else least, np.inf if level == 255 else following


def error_levels(record: RunRecord) -> list[int]:
    """Return the error level in the header of each update of a loop."""
    heads = np.ascontiguousarray(record[NETEM_PACKET]["head"])
    levels: list[int] = heads.view(HEADER_ROW)["error_level"].tolist()
    return levels


@pytest.mark.sanitized
def test_updates_report_their_errors_to_a_queue_that_chooses_by_them(crowded: Content) -> None:
    triggers: Content = {
        "decaying": {"beta": 0.01, "alpha_per_s": 0.2, "floor": 0.01},
        "periodic": {"period_s": 0.03},
        "relative": {"sigma": 0.02},
        "send_on_area": {"delta_s": 0.002},
    }
    loops = [{"name": name, "trigger": {"policy": name, **keys}} for name, keys in triggers.items()]
    tail_drop = run(crowded, *loops)
    crowded["network"]["impairments"][0]["discipline"] = {"kind": "maximum_error"}
    shared = run(crowded, *loops)
    assert replay(shared.network).bit_exact
    assert all(set(error_levels(record)) == {0} for record in tail_drop.loops)
    flows: set[int] = set()
    for record in shared.loops:
        assert replay(record).bit_exact
        first_level, *levels = error_levels(record)
        assert first_level == 255  # the controller knows nothing yet
        events = record[SENSOR_MEASUREMENT][record[SENSOR_MEASUREMENT]["event"] >= 0][1:]
        for level, event in zip(levels, events, strict=True):
            # A periodic trigger has no threshold: its level is that of the error itself.
            share = event["compared"] / event["threshold"] if event["threshold"] else event["e_s_norm"]
            least, following = shares_of(level)
            assert least <= share < following
        flows.update(levels)
    assert min(flows) < 120
    assert max(flows) > 136
