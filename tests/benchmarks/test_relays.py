"""The load generator and the relays: counts only, no rates; and the figures made of them."""

import shutil
import sys
from collections.abc import Iterator

import numpy as np
import pytest

from benchmarks import relays
from benchmarks.relay_load import Built, Burst, built, figures_of, our_relay, running, socat
from benchmarks.report import MeasurementError

needs_compiler = pytest.mark.skipif(
    sys.platform != "linux" or shutil.which("cc") is None, reason="the load is Linux's, and in C"
)


@pytest.fixture(scope="module")
def tools() -> Iterator[Built]:
    with built() as found:
        yield found


@needs_compiler
def test_the_relays_counters_agree_with_sender_and_sink(tools: Built) -> None:
    with running(our_relay("ours", "loss 30% mansd 2 seed 3"), tools) as relay:
        found = relay.ends.burst(relay.pid, 200, slack=2)
        totals = relay.totals()
    assert totals.arrived == 200
    assert totals.forwarded == found.received < 200
    assert totals.longest_loss_burst <= 2
    assert totals.lost_in_kernel == 0
    assert 198 <= found.decided <= 200


def test_without_a_compiler_there_is_one_clear_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda program: None)
    with pytest.raises(MeasurementError, match="cc is not installed"), built():
        pass
    assert isinstance(socat(), str)


def test_an_incomplete_burst_or_delay_gives_no_figure() -> None:
    """The rate counts decided and not forwarded packets; the base delay is subtracted."""
    figures = figures_of("ours", Burst(wall_s=0.01, decided=998, received=950), 1000, 16, 0.003)
    assert figures == pytest.approx({"per_s": 99_800, "cpu_us": 3.0})
    for burst, slack in ((Burst(0.01, 983, 930), 16), (Burst(0.01, 1000, 999), 0)):
        with pytest.raises(MeasurementError, match=f"only {burst.received} arrived"):
            figures_of("relay", burst, 1000, slack, 0.003)
    delays_ns = np.arange(1, 102) * 1000  # 1, 2, ..., 101 µs
    assert relays.quantiles_of("relay", delays_ns, 3.0) == {"p50": 48.0, "p99": 97.0}
    with pytest.raises(MeasurementError, match="relay: 2 of 3 datagrams did not arrive"):
        relays.quantiles_of("relay", np.array([-1, 5, -1]))
