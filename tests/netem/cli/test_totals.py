"""The table at the end."""

import io
from typing import Any

from rich.console import Console

from netem.cli.relay_totals import print_totals
from netem.control.emulator_statistics import Statistics


def direction(**changes: Any) -> Any:
    fates = dict.fromkeys(
        ("delivered", "dropped", "forced", "corrupted", "overflowed", "blacked_out"), 0
    )
    nothing = {"p50": None, "p99": None, "p999": None, "max": None}
    given = {
        "words": "", "arrived": 0, "arrived_bytes": 0, "forwarded": 0, "forwarded_bytes": 0,
        "duplicated": 0, "delivered_out_of_order": 0, "held_back": 0,
        "longest_loss_burst": 0, "mansd": None,
        "loss": {"realised": None, "lost": None, "predicted": 0.0}, "arrived_before": 0,
        "unintended": {"lost_in_kernel": 0},
        "in_flight": 0, "most_in_flight": 0, "flows": [], "delay_ns": nothing,
        "lateness_ns": nothing, "recent": None,
    }  # fmt: skip
    return given | {"fates": fates | changes.pop("fates", {})} | changes


def totals(forward: Any, back: Any) -> Statistics:
    link: Any = {
        "name": "uplink", "listen": "127.0.0.1:1", "to": "[fd00::1]:2", "clients": 0,
        "clients_ever": 1, "refused": 0, "discarded": 0, "port_unreachable": 0,
        "forward": forward, "reverse": back,
    }  # fmt: skip
    return {"time": "", "elapsed_s": 1.0, "engine": "plain", "links": [link]}


def printed(document: Statistics, *, predicted: bool = True) -> list[str]:
    console = Console(file=io.StringIO(), width=100, color_system=None)
    print_totals(document, console, predicted=predicted)
    text: str = console.file.getvalue()  # type: ignore[attr-defined]
    return [" ".join(line.split()) for line in text.splitlines()]


LOSSY = direction(
    words="loss 5% mansd 4", arrived=2000, forwarded=1900, fates={"dropped": 100, "forced": 3},
    longest_loss_burst=4, mansd=4, loss={"realised": 0.05, "lost": 0.05, "predicted": 0.0499},
    delay_ns={"p50": 10_000, "p99": 2_000_000, "p999": 1, "max": 1},
)  # fmt: skip


def test_what_happened_is_told_and_nothing_else() -> None:
    assert printed(totals(LOSSY, direction())) == [
        "uplink: 127.0.0.1:1 → [fd00::1]:2, 1 client",
        "forward",
        "came 2,000",
        "left 1,900",
        "dropped by loss 100",
        "forced through 3",
        "most in a row not delivered 4 of 4 allowed",
        "lost 5.00 %",
        "predicted in the long run 4.99 %",
        "delay: median, 99 % within 10.0 µs, 2.00 ms",
    ]


def test_what_is_overtaken_is_not_called_lost() -> None:
    late = LOSSY | {
        "delivered_out_of_order": 100, "loss": {"realised": 0.1, "lost": 0.05, "predicted": 0.0499},
        "lateness_ns": {"p50": 20_000, "p99": 90_000, "p999": 1, "max": 1},
    }  # fmt: skip
    lines = printed(totals(late, direction()))
    assert lines[-6:] == [
        "most in a row not delivered 4 of 4 allowed",
        "lost 5.00 %",
        "predicted in the long run 4.99 %",
        "lost or stale 10.0 %",
        "delay: median, 99 % within 10.0 µs, 2.00 ms",
        "lateness: median, 99 % within 20.0 µs, 90.0 µs",
    ]


def test_after_a_change_it_says_since_when() -> None:
    lines = printed(totals(LOSSY | {"arrived_before": 500}, direction()))
    place = lines.index("most in a row not delivered 4 of 4 allowed")
    assert lines[place - 1] == "since the last change:"


def test_a_server_that_is_not_there_and_discarded_answers_are_told() -> None:
    document = totals(LOSSY, direction())
    document["links"][0] |= {"port_unreachable": 12, "discarded": 7}  # type: ignore[misc]
    lines = printed(document)
    assert "nobody listened (ICMP) ≥ 12" in lines
    assert "answers discarded, one way 7" in lines


def test_both_directions_stand_side_by_side_once_both_are_used() -> None:
    lines = printed(totals(direction(), LOSSY))
    assert "forward reverse" in lines
    assert "dropped by loss 0 100" in lines


def test_a_replay_is_not_predicted() -> None:
    lines = printed(totals(LOSSY, direction()), predicted=False)
    assert not any("predicted" in line for line in lines)


def test_losses_that_nobody_ordered_are_told() -> None:
    forward = LOSSY | {"unintended": {"lost_in_kernel": 7, "Network is unreachable": 2}}
    lines = printed(totals(forward, direction()))
    assert "unintended: lost in kernel 7" in lines
    assert "unintended: Network is unreachable 2" in lines
    assert lines[-1] == (
        "unintended losses: 9 datagrams; the guarantee does not hold (exit status 3)"
    )
