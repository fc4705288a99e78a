import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks import relay_delay, relay_flows, relay_soak, relays
from benchmarks._relay_load import Burst, Soak
from benchmarks._relay_ours import Ours, Totals, command_of, totals_of
from benchmarks._relay_process import figures_of
from benchmarks._report import MeasurementError, Rounds, Row


def test_the_rate_counts_decided_and_not_forwarded_packets() -> None:
    figures = figures_of("ours", Burst(wall_s=0.01, decided=998, received=950), 1000, 16, 0.003)
    assert figures == pytest.approx({"per_s": 99_800, "cpu_us": 3.0})


@pytest.mark.parametrize(
    ("burst", "slack"), [(Burst(0.01, 983, 930), 16), (Burst(0.01, 1000, 999), 0)]
)
def test_an_incomplete_burst_gives_no_figure(burst: Burst, slack: int) -> None:
    with pytest.raises(MeasurementError, match=f"only {burst.received} arrived"):
        figures_of("relay", burst, 1000, slack, 0.003)


def test_the_goals_of_the_rates() -> None:
    per_s = {
        relays.PLAIN: 260e3, relays.SEGMENTS: 700e3,
        "socat": 120e3, "C relay": 330e3, "C relay, segments": 890e3,
        "C relay, senders' addresses": 320e3, "C relay, segments, senders' addresses": 850e3,
        relays.DIRECT: 420e3,
    }  # fmt: skip
    rounds = Rounds()
    for name, rate in per_s.items():
        rounds.add(name, {"per_s": rate, "cpu_us": 1e6 / rate})
    judged = [row for row in relays.rows_of(rounds) if row.goal is not None]
    assert [(row.name, row.peer.name, row.holds) for row in judged if row.peer is not None] == [
        ("ours: drained", "socat", True),
        ("ours: drained", "C relay", False),
        ("ours, segments: drained", "socat", True),
        ("ours, segments: drained", "C relay, segments", False),
    ]


def test_the_base_delay_is_subtracted() -> None:
    delays_ns = np.arange(1, 102) * 1000  # 1, 2, ..., 101 µs
    assert relay_delay.quantiles_of("relay", delays_ns, 3.0) == {"p50": 48.0, "p99": 97.0}


def test_a_missing_datagram_has_no_delay() -> None:
    with pytest.raises(MeasurementError, match="relay: 2 of 3 datagrams did not arrive"):
        relay_delay.quantiles_of("relay", np.array([-1, 5, -1]))


def delays(**p50_p99: tuple[float, float]) -> Rounds:
    rounds = Rounds()
    for side, (p50, p99) in p50_p99.items():
        rounds.add(side, {"p50": p50, "p99": p99})
    return rounds


def test_only_the_median_of_the_added_delay_is_judged() -> None:
    rounds = delays(ours=(9.0, 30.0), socat=(12.0, 15.0), **{relay_delay.DIRECT: (3.0, 4.0)})
    rounds.missing["C relay"] = "not built"
    rows = relay_delay.added_rows(rounds)
    assert rows[0].value == 3.0
    judged, missing = [row for row in rows if row.goal is not None]
    assert (judged.name, judged.ratio, judged.holds) == ("ours: added one way, p50", 0.75, True)
    assert (missing.name, missing.holds) == (judged.name, None)


@pytest.mark.parametrize("refused", [None, "SCHED_FIFO is refused"])
def test_only_the_99th_percentile_of_the_lateness_is_judged(refused: str | None) -> None:
    rounds = delays(ours=(20.0, 50.0), cyclictest=(15.0, 30.0))
    if refused:
        rounds.add(relay_delay.KERNEL, refused)
    (judged,) = [row for row in relay_delay.lateness_rows(rounds) if row.goal is not None]
    assert (judged.name, judged.value) == ("ours: lateness behind 10 ms, p99", 50.0)
    assert judged.ratio == pytest.approx(5 / 3)
    assert judged.holds is (None if refused else True)


def test_the_cost_of_many_flows_is_compared_with_one_flow() -> None:
    rounds = Rounds()
    for one, many in ((3.0, 4.2), (6.0, 7.2)):
        rounds.add("ours, one flow", {"cpu_us": one})
        rounds.add("ours, 10,000 flows", {"cpu_us": many})
    rounds.missing["ours, with the reverse direction"] = "no such option"
    ours, reverse, *_ = relay_flows.flow_rows(rounds)
    assert ours.ratio == pytest.approx(1.3)
    assert ours.holds is True
    assert reverse.holds is None
    assert "no such option" in reverse.as_json()["note"]


def soaked(**changes: int) -> list[Row]:
    counts = {
        "sent": 1000, "received": 950, "longest_gap": 4, "disordered": 0,
        "arrived": 1000, "forwarded": 950, "lost_in_kernel": 0,
    } | changes  # fmt: skip
    soak = Soak(counts["sent"], counts["received"], 1000, counts["longest_gap"], 0)
    totals = Totals(counts["arrived"], counts["forwarded"], 4, counts["lost_in_kernel"])
    resident_kib = [50e3, 60e3, 60e3, 60e3, 60e3, 61e3]
    return relay_soak.rows_of(
        relay_soak.Found(100.0, 20.0, soak, totals, resident_kib, cpu_s=8.0, waited_s=1.0)
    )


def test_a_load_without_unintended_losses_reaches_all_goals() -> None:
    rows = soaked()
    assert [row.holds for row in rows if row.goal is not None] == [True] * 6
    assert rows[0].ratio == 0.5
    assert (rows[-2].value, rows[-1].value) == (40.0, 5.0)


@pytest.mark.parametrize(
    ("changes", "row"),
    [
        ({"arrived": 999}, "sent but not counted as arrived"),
        ({"received": 949}, "forwarded but not received"),
        ({"lost_in_kernel": 1}, "lost in the relay's receive buffer"),
        ({"longest_gap": 5}, "longest loss burst"),
    ],
)
def test_each_unintended_loss_misses_its_goal(changes: dict[str, int], row: str) -> None:
    assert [found.name for found in soaked(**changes) if found.holds is False] == [row]


def test_memory_growth_is_measured_from_the_second_to_the_last_quarter() -> None:
    start, flat, leak = [100.0, 900.0], [1000.0] * 6, [1000.0 + 7 * k for k in range(8)]
    assert relay_soak.growth_kib([*start, *flat]) == 0
    assert relay_soak.growth_kib(leak) == 7 * 4  # from the mean of samples 2, 3 to that of 6, 7
    assert relay_soak.growth_kib([5.0] * 4) == 0


@pytest.mark.parametrize("per_s", [900.0, 57_321.0, 372_500.0])
def test_group_size_and_period_give_the_rate(per_s: float) -> None:
    size, period_ns = relay_soak.groups(per_s)
    assert size * 1e9 / period_ns == pytest.approx(per_s, rel=1e-4)
    assert size >= 1


def test_the_command_line_of_our_relay() -> None:
    ours = Ours("loss 5% mansd 4", realtime=True, segment=True)
    command = command_of(ours, 9001)
    assert Path(command[0]).name.startswith("python")
    assert " ".join(command[1:]) == (
        "-m netem --listen 127.0.0.1:0 --to 127.0.0.1:9001 loss 5% mansd 4 "
        "--realtime --segment --one-way --json"
    )
    assert "--one-way" not in command_of(Ours("delay 10ms", reverse=True), 9001)


def test_missing_totals_are_an_error() -> None:
    forward = {
        "received": 9, "forwarded": 8, "longest_loss_burst": 1, "unintended": {"lost_in_kernel": 0},
    }  # fmt: skip
    text = json.dumps({"links": [{"forward": forward}], "more": 1})
    assert totals_of(f'{{"ready": []}}\n{text}') == Totals(9, 8, 1, 0)
    with pytest.raises(MeasurementError, match="cannot be read"):
        totals_of("{}")
    with pytest.raises(MeasurementError, match="cannot be read"):
        totals_of("")
