import json
from typing import Any

import pytest

from netem.control.emulator_statistics import (
    AppliedSettings,
    DirectionStatistics,
    Snapshot,
    Statistics,
    statistics,
)
from netem.relay_links import FlowReport
from noack.core.clock import NS_PER_S
from noack.impairments.link_settings import Counters
from tests.netem.control.relays import FakeRelay, times

UNIX_NS = 1_790_000_000 * NS_PER_S + 250_000_000


def look(relay: FakeRelay, elapsed_s: float, since: Any = None) -> Snapshot:
    in_force = {
        key: AppliedSettings(settings, (since or {}).get(key, Counters()))
        for key, settings in relay.settings.items()
    }
    return Snapshot(relay.report(), in_force, round(elapsed_s * NS_PER_S), UNIX_NS)


def forward(document: Statistics, link: int = 0) -> DirectionStatistics:
    return document["links"][link]["forward"]


def test_the_statistics_contain_every_counter_of_a_relay(relay: FakeRelay) -> None:
    relay.counters["up", "forward"] = Counters(
        received=100, received_bytes=7200, delivered=80, dropped=8, forced=5, corrupted=4,
        overflowed=2, blacked_out=1, duplicated=3, held_back=6, forwarded=91,
        forwarded_bytes=6552, delivered_out_of_order=9, longest_loss_burst=2, most_in_flight=17,
    )  # fmt: skip
    relay.flows = [FlowReport(3, ("::1", 4000), 60, 2)]
    relay.unintended["lost_in_kernel"] = 7
    document = statistics(look(relay, 2.5))
    assert document["time"] == "2026-09-21T14:13:20.250000+00:00"
    assert document["elapsed_s"] == 2.5
    up, down = document["links"]
    assert (up["name"], up["listen"], up["to"]) == ("up", "127.0.0.1:5000", "[::1]:6000")
    assert (up["clients"], up["clients_ever"], up["refused"]) == (1, 3, 0)
    found = forward(document)
    assert found["words"] == "loss 10% delay 10ms mansd 2"
    assert (found["received"], found["received_bytes"]) == (100, 7200)
    assert (found["forwarded"], found["forwarded_bytes"]) == (91, 6552)
    assert found["fates"] == {
        "delivered": 80, "dropped": 8, "forced": 5, "corrupted": 4, "overflowed": 2,
        "blacked_out": 1,
    }  # fmt: skip
    assert (found["duplicated"], found["delivered_out_of_order"], found["held_back"]) == (3, 9, 6)
    assert (found["longest_loss_burst"], found["mansd"]) == (2, 2)
    assert (found["in_flight"], found["most_in_flight"]) == (5, 17)
    assert found["unintended"] == {"lost_in_kernel": 7, "send_errors": 0}
    assert found["flows"] == [
        {"flow": 3, "client": "[::1]:4000", "packets": 60, "longest_loss_burst": 2}
    ]  # fmt: skip
    assert found["loss"]["realised"] == pytest.approx((100 - 80 - 5 + 9) / 100)
    assert found["loss"]["drawn"] == pytest.approx((8 + 4) / 100)
    assert found["loss"]["lost"] == pytest.approx((8 + 4 + 2 + 1) / 100)
    assert found["recent"] is None
    assert (down["name"], down["reverse"]["mansd"]) == ("down", None)
    assert json.loads(json.dumps(document, allow_nan=False)) == document


def test_rates_are_differences_of_two_documents(relay: FakeRelay) -> None:
    relay.counters["up", "forward"] = Counters(
        received=50, received_bytes=5000, delivered=40, dropped=10, forwarded=40,
        forwarded_bytes=4000,
    )  # fmt: skip
    relay.delays = times(1_000_000)
    before = look(relay, 10)
    relay.counters["up", "forward"] = Counters(
        received=450, received_bytes=45_000, delivered=140, dropped=310, forwarded=140,
        forwarded_bytes=14_000,
    )  # fmt: skip
    relay.delays = times(1_000_000, 5_000_000, 5_000_000)
    recent = forward(statistics(look(relay, 12), before))["recent"]
    assert recent is not None
    assert recent["seconds"] == 2
    assert (recent["received_per_s"], recent["received_bits_per_s"]) == (200, 160_000)
    assert (recent["forwarded_per_s"], recent["forwarded_bits_per_s"]) == (50, 40_000)
    assert recent["loss"] == pytest.approx(0.75)
    assert recent["delay_ns"]["p50"] == pytest.approx(5_000_000, rel=0.03)


def test_loss_is_counted_since_the_settings_came_into_force(relay: FakeRelay) -> None:
    now = Counters(received=300, delivered=150, dropped=150)
    relay.counters["up", "forward"] = now
    since = {("up", "forward"): Counters(received=100, delivered=100)}
    found = forward(statistics(look(relay, 1, since)))
    assert found["loss"]["realised"] == pytest.approx(0.75)
    assert found["loss"]["lost"] == pytest.approx(0.75)
    assert (found["received_before"], found["received"]) == (100, 300)


def test_late_stale_packets_do_not_raise_the_loss_above_one(relay: FakeRelay) -> None:
    before = look(relay, 1)
    relay.counters["up", "forward"] = Counters(received=1, delivered=1, delivered_out_of_order=5)
    recent = forward(statistics(look(relay, 2), before))["recent"]
    assert recent is not None
    assert recent["loss"] == 1
