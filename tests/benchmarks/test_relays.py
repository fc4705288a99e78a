import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks import relays
from benchmarks.relays import Burst, Totals, figures_of, new_soak, our_relay
from benchmarks.report import MeasurementError, Rounds, Row


def test_the_rate_counts_decided_and_not_forwarded_packets() -> None:
    figures = figures_of("ours", Burst(wall_s=0.01, decided=998, received=950), 1000, 16, 0.003)
    assert figures == pytest.approx({"per_s": 99_800, "cpu_us": 3.0})


@pytest.mark.parametrize(
    ("burst", "slack"), [(Burst(0.01, 983, 930), 16), (Burst(0.01, 1000, 999), 0)]
)
def test_an_incomplete_burst_gives_no_figure(burst: Burst, slack: int) -> None:
    with pytest.raises(MeasurementError, match=f"only {burst.received} arrived"):
        figures_of("relay", burst, 1000, slack, 0.003)


def test_the_base_delay_is_subtracted() -> None:
    delays_ns = np.arange(1, 102) * 1000  # 1, 2, ..., 101 µs
    assert relays.quantiles_of("relay", delays_ns, 3.0) == {"p50": 48.0, "p99": 97.0}


def test_a_missing_datagram_has_no_delay() -> None:
    with pytest.raises(MeasurementError, match="relay: 2 of 3 datagrams did not arrive"):
        relays.quantiles_of("relay", np.array([-1, 5, -1]))


def test_the_cost_of_many_flows_is_compared_with_one_flow() -> None:
    rounds = Rounds()
    for one, many in ((3.0, 4.2), (6.0, 7.2)):
        rounds.add("ours, one flow", {"cpu_us": one})
        rounds.add("ours, 10,000 flows", {"cpu_us": many})
    rounds.missing["ours, with the reverse direction"] = "no such option"
    ours, reverse, *_ = relays.flow_rows(rounds)
    assert ours.ratio == pytest.approx(1.3)
    assert ours.holds is True
    assert reverse.holds is None
    assert "no such option" in reverse.as_json()["note"]


def soaked(**changes: int) -> list[Row]:
    counts = {
        "sent": 1000, "received": 950, "longest_gap": 4, "disordered": 0,
        "arrived": 1000, "forwarded": 950, "lost_in_kernel": 0,
    } | changes  # fmt: skip
    soak = new_soak()
    for name in ("sent", "received", "longest_gap"):
        setattr(soak, name, counts[name])
    totals = Totals(counts["arrived"], counts["forwarded"], 4, counts["lost_in_kernel"])
    resident_kib = [50e3, 60e3, 60e3, 60e3, 60e3, 61e3]
    return relays.soak_rows(
        relays.Soaked(100.0, 20.0, soak, totals, resident_kib, cpu_s=8.0, waited_s=1.0)
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
    assert relays.growth_kib([*start, *flat]) == 0
    assert relays.growth_kib(leak) == 7 * 4  # from the mean of samples 2, 3 to that of 6, 7
    assert relays.growth_kib([5.0] * 4) == 0


@pytest.mark.parametrize("per_s", [900.0, 57_321.0, 372_500.0])
def test_group_size_and_period_give_the_rate(per_s: float) -> None:
    size, period_ns = relays.groups(per_s)
    assert size * 1e9 / period_ns == pytest.approx(per_s, rel=1e-4)
    assert size >= 1


def test_the_command_line_of_our_relay() -> None:
    kind = our_relay("ours", "loss 5% mansd 4", "--realtime", "--segment")
    command = kind.command(9001, 0)
    assert Path(command[0]).name.startswith("python")
    assert " ".join(command[1:]) == (
        "-m netem --listen 127.0.0.1:0 --to 127.0.0.1:9001 loss 5% mansd 4 "
        "--realtime --segment --one-way --json"
    )
    assert "--one-way" not in our_relay("ours", "delay 10ms", reverse=True).command(9001, 0)


def test_missing_totals_are_an_error() -> None:
    forward = {
        "received": 9, "forwarded": 8, "longest_loss_burst": 1, "unintended": {"lost_in_kernel": 0},
    }  # fmt: skip
    text = json.dumps({"links": [{"forward": forward}], "more": 1})
    assert Totals.parse(f'{{"ready": []}}\n{text}') == Totals(9, 8, 1, 0)
    with pytest.raises(MeasurementError, match="cannot be read"):
        Totals.parse("{}")
    with pytest.raises(MeasurementError, match="cannot be read"):
        Totals.parse("")
