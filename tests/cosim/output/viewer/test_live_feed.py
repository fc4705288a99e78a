"""The recording of several loops that is written while they run, against that of the record."""

from pathlib import Path
from unittest.mock import Mock, create_autospec

import numpy as np
import pytest

from cosim.analysis.summary.loops_over_time import INTERVALS, loops_over_time, quantiles
from cosim.analysis.summary.run_summary import counts_inside, times_inside
from cosim.output.viewer import blueprint as bp
from cosim.output.viewer.live_feed import LiveFeed
from cosim.output.viewer.loop_feed import LoopFeed
from cosim.output.viewer.loop_recording import LoopView
from cosim.output.viewer.run_recording import ALL_ERRORS, ALL_SIZES, MAP, QUEUE, SHARE, open_recording
from cosim.record.run_directory import RECORDING_FILE
from cosim.record.run_record import RecordedRun
from cosim.simulation.virtual_time import simulate_loops
from netem.core.packet_rows import NETEM_PACKET, PACKET_HEAD_BYTES, Fate
from noack.protocol.record_tables import tables
from noack.protocol.roles import Notice
from noack.protocol.wire_format import Encoder, Flow, Message
from noack.scenario.resolution import loop_of, resolve_run
from tests.cosim.output.viewer.recordings import Chunks, read, series
from tests.helpers.rows_of_loops import live_rows
from tests.helpers.shipped import resolved, shipped


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Loops are not given up, and no lag is named, on a busy machine."""
    for name in ("_WARNED_LAG_S", "_LONGEST_LAG_S"):
        monkeypatch.setattr(f"cosim.output.viewer.live_feed.{name}", np.inf)


def shown(folder: Path, count: int, *settings: str) -> tuple[RecordedRun, Chunks, list[str]]:
    """Simulate loops, and pass their rows on as in a live run; read the recording."""
    all_settings = ["horizon_s=2.0", f'loops=[{{ name = "p", count = {count} }}]', *settings]
    run = simulate_loops(resolve_run(shipped("shared_bottleneck", *all_settings)))
    messages = list[str]()
    with open_recording(run.resolved, folder, 9, None) as view:
        feed = LiveFeed(run.resolved, view, messages.append)
        for table, rows in live_rows(run):
            feed.add(table, rows)
            feed.advance()
        feed.log(Notice(10**9, "violation", "x is not finite", loop=1).line())
        feed.advance(final=True)
    return run, read(folder / RECORDING_FILE), messages


@pytest.mark.parametrize(("count", "phase"), [(3, "0.3"), (30, "0.0")])
def test_all_loops_are_shown_as_from_the_record(tmp_path: Path, count: int, phase: str) -> None:
    run, chunks, messages = shown(tmp_path, count, f"controller.phase={phase}")
    expected = loops_over_time(run)
    for entity, values in ((ALL_ERRORS, expected.errors), (ALL_SIZES, expected.states)):
        t_ns, log_values = series(chunks, entity)
        assert (np.diff(t_ns) > 0).all()
        assert len(t_ns) == INTERVALS
        curves = (values if count == 3 else quantiles(values)).T
        known = np.isfinite(curves)
        difference = np.abs(10**log_values - curves)[known]
        smallest = 1e-5 * np.nanmax(curves)  # curves are cut off below
        close = difference <= 1e-3 * curves[known] + smallest
        assert close.mean() > 0.99  # at the start, the newest tick may be before x(0)
    horizon_ns = run.network.scenario.timing.horizon_ns
    edges_ns = np.linspace(0, horizon_ns, INTERVALS + 1)
    means, largest = counts_inside(*times_inside(run.network[NETEM_PACKET]), edges_ns)
    np.testing.assert_allclose(series(chunks, QUEUE)[1], np.column_stack([largest, means]), atol=1e-6)
    shares = 100 * expected.shares()[1]
    curves = (shares if count == 3 else quantiles(shares)).T
    np.testing.assert_allclose(series(chunks, SHARE)[1], curves, rtol=1e-6)
    assert (MAP in chunks) == (count == 30)
    assert not messages
    assert bp.LOG in chunks


def test_loops_in_detail_that_cannot_keep_up_are_given_up_and_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cosim.output.viewer.live_feed._TURN_S", -1.0)  # one loop a turn
    monkeypatch.setattr("cosim.output.viewer.live_feed._WARNED_LAG_S", 0.05)
    monkeypatch.setattr("cosim.output.viewer.live_feed._LONGEST_LAG_S", 0.5)
    monkeypatch.setattr("cosim.output.viewer.live_feed._CORE_SHARE", 1e-4)
    _, chunks, messages = shown(tmp_path, 3)
    assert "in detail end here" in messages[-1]
    assert len(series(chunks, ALL_ERRORS)[0]) == INTERVALS
    with pytest.raises(ValueError, match="at least one array"):  # nothing but static data
        series(chunks, f"{bp.loop_folder('p-1')}{bp.state_path('angle')}")


SCENARIO = resolved("lane_following")
LOOP = loop_of(SCENARIO)
TYPES = tables(LOOP.n, LOOP.m)
MS = 1_000_000


def ticks(first: int, count: int) -> np.ndarray:
    rows = np.zeros(count, TYPES["controller_step"])
    rows["input"] = rows["sequence"] = np.arange(first, first + count)
    rows["t_ns"] = rows["model_t_ns"] = rows["now_ns"] = rows["input"] * 2 * MS
    return rows


def received(view: Mock) -> list[tuple[int, bool]]:
    calls = [call.args for call in view.add_deliveries.call_args_list]
    return [delivery for t_ns, _, forced in calls for delivery in zip(t_ns, forced, strict=True)]


def test_a_delivery_is_drawn_once_the_networks_row_has_arrived() -> None:
    view = create_autospec(LoopView, instance=True)
    feed = LoopFeed(SCENARIO, view)
    delivery = np.zeros(1, TYPES["controller_delivery"])
    delivery["t_ns"] = delivery["model_t_ns"] = 100 * MS
    delivery["sequence"] = 5
    delivery["input"] = 50
    feed.add("controller_delivery", delivery)
    feed.add("controller_step", ticks(0, 50))
    feed.advance()
    assert received(view) == []

    packet = np.zeros(1, TYPES["netem_packet"])
    update = Message(Flow.UPDATE, 5, 100 * MS, np.zeros(LOOP.n))
    packet["head"] = np.void(Encoder(1, bytes(32)).encode(update)[:PACKET_HEAD_BYTES])
    packet["fate"] = Fate.FORCED
    feed.add("netem_packet", packet)
    feed.add("controller_step", ticks(51, 300))
    feed.advance()
    assert received(view) == [(100 * MS, True)]
