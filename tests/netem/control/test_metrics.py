"""Metrics are what Prometheus reads, and say the same as the statistics."""

import re
from pathlib import Path

import pytest

from netem.control.command_queue import CommandQueue
from netem.control.control_server import ControlAddresses
from netem.control.emulator_statistics import statistics
from netem.control.metrics_text import metrics_text
from netem.impairments.link_settings import Counters
from tests.helpers.prometheus import of, parsed
from tests.netem.control.fake_relay import FakeRelay, times
from tests.netem.control.http_requests import request, unix

PAGE = Path(__file__).parents[3] / "docs/netem-control.md"
_UNITS = ("_packets", "_bytes", "_seconds", "_ratio", "clients", "_total")


@pytest.fixture
def busy(relay: FakeRelay) -> FakeRelay:
    relay.counters["up", "forward"] = Counters(
        received=100, received_bytes=7200, delivered=80, dropped=8, forced=5, corrupted=4,
        overflowed=2, blacked_out=1, duplicated=3, held_back=6, forwarded=91,
        forwarded_bytes=6552, delivered_out_of_order=9, longest_loss_burst=2, most_in_flight=17,
    )  # fmt: skip
    relay.unintended = {"lost_in_kernel": 7, 'a "strange"\\\nreason': 1}
    relay.delays = times(1000, 10_000_000, 10_000_000, 2**24, 90_000_000_000)
    return relay


def test_metrics_say_what_the_statistics_say(busy: FakeRelay, server: ControlAddresses) -> None:
    answer = request(unix(server), "GET", "/metrics")
    assert answer.headers["Content-Type"] == "text/plain; version=0.0.4; charset=utf-8"
    families = parsed(answer.text)
    up = {"link": "up", "direction": "forward"}
    assert of(families, "received_packets_total", **up) == 100
    assert of(families, "received_bytes_total", **up) == 7200
    assert of(families, "forwarded_packets_total", **up) == 91
    assert of(families, "packets_total", **up, fate="forced") == 5
    fates = families["noack_netem_packets_total"].samples
    assert sum(value for (_, labels), value in fates.items() if up.items() <= labels) == 100
    assert of(families, "unintended_losses_total", **up, cause="lost_in_kernel") == 7
    assert of(families, "unintended_losses_total", **up, cause=r"a \"strange\"\\\nreason") == 1
    assert of(families, "mansd_packets", **up) == 2
    assert ("noack_netem_mansd_packets", frozenset({("link", "up"), ("direction", "reverse")})) not in (
        families["noack_netem_mansd_packets"].samples
    )
    assert of(families, "clients", link="up") == 1
    assert of(families, "clients_total", link="down") == 3
    assert of(families, "uptime_seconds") > 0


def test_names_follow_the_conventions(busy: FakeRelay, server: ControlAddresses) -> None:
    for name, family in parsed(request(unix(server), "GET", "/metrics").text).items():
        assert name.startswith("noack_netem_")
        assert name.endswith(_UNITS)
        assert name.endswith("_total") == (family.kind == "counter")
        assert family.samples
        for _, labels in family.samples:
            assert {label for label, _ in labels} <= {"link", "direction", "fate", "cause", "le"}


def test_histograms_are_cumulative(busy: FakeRelay, commands: CommandQueue) -> None:
    families = parsed(metrics_text(statistics(commands.snapshot())))
    buckets = {
        float(dict(labels)["le"]): value
        for (name, labels), value in families["noack_netem_delay_seconds"].samples.items()
        if name.endswith("_bucket") and {("link", "up"), ("direction", "forward")} <= labels
    }
    counts = [buckets[limit_s] for limit_s in sorted(buckets)]
    assert counts == sorted(counts)
    assert min(buckets) == 65535e-9
    # A time is in the bucket of the smallest limit that it does not exceed.
    assert dict(zip(sorted(buckets)[-3:], counts[-3:], strict=True)) == {
        (2**34 - 1) / 1e9: 4, (2**35 - 1) / 1e9: 4, float("inf"): 5,
    }  # fmt: skip
    assert [value for limit_s, value in buckets.items() if limit_s < 0.0168] == 8 * [1] + [3]
    assert buckets[(2**25 - 1) / 1e9] == 4
    assert of(families, "delay_seconds_count", link="up", direction="forward") == 5


def test_every_metric_is_documented_and_no_other(busy: FakeRelay, server: ControlAddresses) -> None:
    (table,) = re.findall(
        r"^\| metric \| type \| \|\n\|---\|---\|---\|\n((?:\|.*\n)+)", PAGE.read_text(), re.M
    )
    documented: dict[str, str] = {}
    for row in table.splitlines():
        names, kinds, _ = (cell.strip() for cell in row.strip("|").split("|"))
        listed = re.findall("`(\\w+)`", names)
        each = kinds.split(", ") if ", " in kinds else [kinds] * len(listed)
        documented |= {f"noack_netem_{name}": kind for name, kind in zip(listed, each, strict=True)}
    families = parsed(request(unix(server), "GET", "/metrics").text)
    assert {name: family.kind for name, family in families.items()} == documented
