"""The metrics of an emulator are its statistics, read by the parser of prometheus_client."""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

import pytest
from prometheus_client import CollectorRegistry
from prometheus_client.openmetrics.exposition import generate_latest
from prometheus_client.openmetrics.parser import text_string_to_metric_families

from netem import stand_alone
from netem.control.emulator_metrics import EmulatorMetrics, metrics
from netem.control.emulator_statistics import CommandQueue, statistics
from netem.stand_alone import attached
from noack.runtime.address import text_of
from noack.runtime.connections import metrics_server as servers
from tests.netem.control.relays import FakeRelay, options
from tests.noack.runtime.test_metrics_server import read, slow_reader

Values = dict[str, float]


def values_of(text: str) -> Values:
    """The value of each sample, by its name and its labels."""
    return {
        ",".join([sample.name, *sorted(sample.labels.values())]): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def exposed(collector: object) -> str:
    registry = CollectorRegistry()
    registry.register(collector)  # type: ignore[arg-type]
    return str(generate_latest(registry).decode())


class Fixed:
    def __init__(self, collect: Callable[[], object]) -> None:
        self.collect = collect


def test_metrics_are_the_statistics(relay: FakeRelay) -> None:
    counters = relay.counters["up", "forward"]
    counters.received, counters.dropped, counters.delivered = 10, 3, 7
    commands = CommandQueue(relay)
    found = statistics(commands.look())
    values = values_of(exposed(Fixed(lambda: metrics(found))))
    assert values["noack_netem_received_datagrams_total,forward,up"] == 10
    assert values["noack_netem_datagrams_total,dropped,forward,up"] == 3
    assert values["noack_netem_loss_ratio,forward,up"] == pytest.approx(0.3)
    limit = found["links"][0]["forward"]["mansd"]
    assert values.get("noack_netem_loss_burst_limit,forward,up") == limit
    assert values["noack_netem_elapsed_seconds"] == found["elapsed_s"]
    unintended = found["links"][0]["forward"]["unintended"]
    for cause, count in unintended.items():
        labels = ",".join(sorted([cause, "forward", "up"]))
        assert values[f"noack_netem_unintended_losses_total,{labels}"] == count
    commands.close()
    assert list(EmulatorMetrics(commands).collect()) == []  # of a relay that has ended


def test_an_emulator_serves_its_metrics_and_ends_beside_a_slow_reader(
    relay: FakeRelay, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    threads = threading.active_count()
    monkeypatch.setattr(servers, "_REQUEST_S", 3600.0)
    asked: list[tuple[str, int]] = []
    monkeypatch.setattr(stand_alone, "text_of", lambda at: asked.append(at) or text_of(at))
    with (
        ExitStack() as stack,
        attached(relay, options("--metrics", ":0")) as side,
        ThreadPoolExecutor() as pool,
    ):
        stack.enter_context(slow_reader(asked[0]))
        relay.counters["up", "forward"].received = 4
        reading = pool.submit(read, asked[0])
        while not reading.done():
            side.commands.run_pending()
        values = values_of(reading.result())
    assert threading.active_count() == threads
    assert values["noack_netem_received_datagrams_total,forward,up"] == 4
    assert (
        capfd.readouterr().err == f"noack netem: metrics: http://127.0.0.1:{asked[0][1]}/metrics\n"
    )
