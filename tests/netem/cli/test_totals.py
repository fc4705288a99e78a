"""The table of totals that the emulator prints at its end."""

import io
from typing import Any

from rich.console import Console

from netem.control.emulator_statistics import Statistics
from netem.stand_alone import print_totals

NO_FATES = dict.fromkeys(
    ("delivered", "dropped", "forced", "corrupted", "overflowed", "blacked_out"), 0
)
UNUSED: Any = {
    "words": "", "received": 0, "forwarded": 0, "fates": NO_FATES, "duplicated": 0,
    "delivered_out_of_order": 0, "held_back": 0, "longest_loss_burst": 0, "mansd": None,
    "constraints": [],
    "loss": {"realised": None, "lost": None, "predicted": 0.0}, "received_before": 0,
    "unintended": {"lost_in_kernel": 0}, "in_flight": 0,
    "delay_ns": {"p50": None, "p99": None}, "lateness_ns": {"p50": None, "p99": None},
}  # fmt: skip
LOSSY = UNUSED | {
    "words": "loss 5% mansd 4", "received": 2000, "forwarded": 1900,
    "fates": NO_FATES | {"dropped": 100, "forced": 3}, "longest_loss_burst": 4, "mansd": 4,
    "loss": {"realised": 0.05, "lost": 0.05, "predicted": 0.0499},
    "delay_ns": {"p50": 10_000, "p99": 2_000_000},
}  # fmt: skip


def printed(
    forward: Any, reverse: Any = UNUSED, *, predicted: bool = True, **more: Any
) -> list[str]:
    link: Any = {
        "name": "uplink", "listen": "127.0.0.1:1", "to": "[fd00::1]:2", "clients_ever": 1,
        "refused": 0, "discarded": 0, "port_unreachable": 0, "forward": forward, "reverse": reverse,
    }  # fmt: skip
    totals: Statistics = {"time": "", "elapsed_s": 1.0, "links": [link | more]}
    file = io.StringIO()
    print_totals(totals, Console(file=file, width=80, color_system=None), predicted=predicted)
    return [" ".join(line.split()) for line in file.getvalue().splitlines()]


def test_only_rows_that_apply_are_shown() -> None:
    assert printed(LOSSY) == [
        "uplink: 127.0.0.1:1 → [fd00::1]:2, 1 client",
        "forward",
        "received 2,000",
        "forwarded 1,900",
        "dropped by a loss model 100",
        "forced by the guarantee 3",
        "longest loss burst 4, cap 4",
        "loss rate 5.00 %",
        "predicted 4.99 %",
        "delay p50, p99 10.0 µs, 2.00 ms",
    ]


def test_the_title_is_one_line_at_any_width() -> None:
    (title, *_) = printed(LOSSY, name="a-long-name-of-a-link-that-fills-the-line-by-itself-already")
    assert title.endswith("→ [fd00::1]:2, 1 client")


def test_all_rows_of_both_directions_are_shown() -> None:
    stale = LOSSY | {
        "delivered_out_of_order": 100, "loss": {"realised": 0.1, "lost": 0.05, "predicted": 0.0499},
        "lateness_ns": {"p50": 20_000, "p99": 90_000}, "received_before": 500,
        "unintended": {"lost_in_kernel": 7, "Network is unreachable": 2},
    }  # fmt: skip
    assert printed(UNUSED, stale, port_unreachable=12, discarded=7, refused=3)[1:] == [
        "forward reverse",
        "received 0 2,000",
        "forwarded 0 1,900",
        "dropped by a loss model 0 100",
        "forced by the guarantee 0 3",
        "delivered out of order (stale) 0 100",
        "since the last change:",
        "longest loss burst 0, no cap 4, cap 4",
        "loss rate – 5.00 %",
        "predicted 0 % 4.99 %",
        "loss rate with stale – 10.0 %",
        "delay p50, p99 – 10.0 µs, 2.00 ms",
        "lateness p50, p99 – 20.0 µs, 90.0 µs",
        "unintended: Network is unreachable 0 2",
        "unintended: lost in kernel 0 7",
        "refused: too many clients 3",
        "port unreachable (ICMP) ≥ 12",
        "answers discarded (--one-way) 7",
        "unintended losses: 9 datagrams; the guarantee does not hold (exit status 3)",
    ]


def test_a_replay_has_no_prediction() -> None:
    assert not any("predicted" in line for line in printed(LOSSY, predicted=False))
