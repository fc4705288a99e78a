"""Statistics of constructed reports, as a document, on a terminal and as lines; and their page."""

import io
import json
import re
from contextlib import redirect_stdout
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast, get_type_hints

import pytest

from netem.__main__ import main
from netem.control import emulator_statistics
from netem.control.command_queue import AppliedSettings, Snapshot
from netem.control.control_server import control_server
from netem.control.emulator_statistics import DirectionStatistics, Statistics, rate_interval, statistics
from netem.control.statistics_text import statistics_lines
from netem.core.clock import NS_PER_S
from netem.impairments.link_settings import Counters
from netem.relay.relay_reports import FlowReport
from tests.netem.control.fake_relay import FakeRelay, running

UNIX_NS = 1_790_000_000 * NS_PER_S + 250_000_000


def snapshot_of(relay: FakeRelay, elapsed_s: float, since: Any = None) -> Snapshot:
    applied = {
        key: AppliedSettings(settings, (since or {}).get(key, Counters()))
        for key, settings in relay.settings.items()
    }
    return Snapshot(relay.report(), applied, round(elapsed_s * NS_PER_S), UNIX_NS)


def forward(document: Statistics, link: int = 0) -> DirectionStatistics:
    return document["links"][link]["forward"]


def test_the_statistics_contain_every_counter_of_a_relay(relay: FakeRelay) -> None:
    counted = Counters(
        received=100, received_bytes=7200, delivered=80, dropped=8, forced=5, corrupted=4,
        overflowed=2, blacked_out=1, duplicated=3, held_back=6, forwarded=91,
        forwarded_bytes=6552, delivered_out_of_order=9, longest_loss_burst=2, most_in_flight=17,
    )  # fmt: skip
    relay.counters["up", "forward"] = counted
    relay.flows = [FlowReport(3, "[::1]:4000", 60, 2)]
    relay.unintended["lost_in_kernel"] = 7
    document = statistics(snapshot_of(relay, 2.5))
    assert document["time"] == "2026-09-21T14:13:20.250000+00:00"
    assert document["elapsed_s"] == 2.5
    up, down = document["links"]
    assert (up["name"], up["listen"], up["to"]) == ("up", "127.0.0.1:5000", "[::1]:6000")
    assert (up["clients"], up["clients_ever"], up["refused"]) == (1, 3, 0)
    direction = forward(document)
    assert direction["words"] == "loss 10% delay 10ms mansd 2"
    shown = cast(dict[str, Any], direction | direction["fates"])
    for name, number in asdict(counted).items():
        assert shown[name] == number, name
    assert sum(direction["fates"].values()) == 100
    assert (direction["mansd"], direction["in_flight"]) == (2, 5)
    assert direction["unintended"] == {"lost_in_kernel": 7, "send_errors": 0}
    assert direction["flows"] == [
        {"flow": 3, "client": "[::1]:4000", "packets": 60, "longest_loss_burst": 2}
    ]  # fmt: skip
    assert direction["loss"]["realised"] == pytest.approx((100 - 80 - 5 + 9) / 100)
    assert direction["loss"]["drawn"] == pytest.approx((8 + 4) / 100)
    assert direction["loss"]["lost"] == pytest.approx((8 + 4 + 2 + 1) / 100)
    assert direction["recent"] is None
    assert (down["name"], down["reverse"]["mansd"]) == ("down", None)
    assert json.loads(json.dumps(document, allow_nan=False)) == document


def test_loss_is_counted_since_the_settings_came_into_force(relay: FakeRelay) -> None:
    """And is at most 1, although late packets become stale."""
    relay.counters["up", "forward"] = Counters(received=300, delivered=150, dropped=150)
    since = {("up", "forward"): Counters(received=100, delivered=100)}
    before = snapshot_of(relay, 1, since)
    direction = forward(statistics(before))
    assert direction["loss"]["realised"] == direction["loss"]["lost"] == pytest.approx(0.75)
    assert (direction["received_before"], direction["received"]) == (100, 300)
    assert "loss 75.0 % of the 200 since the last change  drawn" in next(statistics_lines(statistics(before)))
    relay.counters["up", "forward"] = Counters(
        received=301, delivered=151, dropped=150, delivered_out_of_order=5
    )
    recent = forward(statistics(snapshot_of(relay, 2, since), before))["recent"]
    assert recent is not None
    assert recent["loss"] == 1


PAGE = (Path(__file__).parents[3] / "docs/netem-control.md").read_text()


def rows(title: str) -> dict[str, str]:
    """Return the table with this title as a mapping from first column to second column."""
    (table,) = re.findall(rf"^\| {title} \| \|\n\|---\|---\|\n((?:\|.*\n)+)", PAGE, re.MULTILINE)
    return dict(row.strip("| \n").split(" | ", 1) for row in table.splitlines())


def names(text: str) -> set[str]:
    return set(re.findall("`([a-z0-9_]+)`", text))


def explained() -> dict[str, Any]:
    out = io.StringIO()
    with redirect_stdout(out):
        assert main(["--explain", "--json", "loss 5%"]) == 0
    (link,) = json.loads(out.getvalue())["links"]
    return dict(link)


@pytest.mark.parametrize(
    ("title", "keys"),
    [
        ("document", get_type_hints(emulator_statistics.Statistics)),
        ("link", get_type_hints(emulator_statistics.LinkStatistics)),
        ("direction", get_type_hints(emulator_statistics.DirectionStatistics)),
        ("recent", get_type_hints(emulator_statistics.RecentRates)),
        ("explained link", explained()),
        ("explained direction", explained()["forward"]),
    ],
)
def test_every_key_is_documented_and_no_other(title: str, keys: dict[str, Any]) -> None:
    assert set().union(*map(names, rows(title))) == set(keys)
    text = rows("direction")
    assert names(text["`loss`"]) == set(get_type_hints(emulator_statistics.LossStatistics))
    assert names(text["`flows`"]) == set(get_type_hints(emulator_statistics.FlowStatistics))
    assert names(text["`delay_ns`"]) == set(get_type_hints(emulator_statistics.DelayQuantiles))


def test_the_documented_program_runs(capsys: pytest.CaptureFixture[str]) -> None:
    relay = FakeRelay("relay")
    (change,) = re.findall(r"^```python\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    with running(relay) as commands, control_server("lab", commands):
        exec(change, {})
    assert capsys.readouterr().out == "None\n"
    assert relay.settings["relay", "reverse"].mansd == 2


def test_a_measured_rate_has_an_interval() -> None:
    """Wilson's for independent losses; wider for bursts, narrower under a cap."""
    low, high = rate_interval(20, 100, 0.16, 0.2) or ()
    assert (low, high) == pytest.approx((0.13337, 0.28883), abs=1e-5)  # Wilson (1927)
    assert rate_interval(20, 100, None, None) == pytest.approx([low, high])
    wide, narrow = rate_interval(20, 100, 0.5, 0.2) or [], rate_interval(20, 100, 0.02, 0.2) or []
    assert wide[0] < low < narrow[0] < 0.2 < narrow[1] < high < wide[1]
    assert rate_interval(0, 0, None, None) is None
    assert rate_interval(0, 50, 0.0, 0.0) == pytest.approx([0.0, 0.0714], abs=1e-3)
