"""The feed receives batches of the processes in any order; the view shows them aligned."""

import gc
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cosim.output.viewer.table_feed
from cosim.output.viewer.pictures.picture import Frames
from cosim.output.viewer.table_feed import ViewFeed
from noack.protocol.record_tables import PACKET_HEAD_BYTES, Fate, tables
from noack.protocol.wire_format import Encoder, Flow, Message
from noack.scenario.resolution import loop_of, resolve
from noack.scenario.scenario_file import load

ROOT = Path(__file__).parents[4]
SCENARIO = resolve(load(ROOT / "scenarios" / "lane_following.toml"))
LOOP = loop_of(SCENARIO)
TYPES = tables(LOOP.n, LOOP.m)
MS = 1_000_000


class Drawn:
    """A view that stores its input."""

    def __init__(self) -> None:
        self.forced: list[tuple[int, bool]] = []
        self.frames: list[tuple[Any, Frames]] = []

    def move(self, t_ns: Any, frames: Frames) -> None:
        self.frames.append((t_ns, frames))

    def receptions(self, t_ns: Any, interval_s: Any, forced: Any) -> None:
        self.forced += list(zip(t_ns.tolist(), forced.tolist(), strict=True))

    def __getattr__(self, name: str) -> Any:
        return lambda *arguments, **options: None


def ticks(first: int, count: int) -> np.ndarray:
    rows = np.zeros(count, TYPES["controller_step"])
    rows["input"] = rows["sequence"] = np.arange(first, first + count)
    rows["t_ns"] = rows["model_t_ns"] = rows["now_ns"] = rows["input"] * 2 * MS
    return rows


def test_a_delivery_is_drawn_once_the_networks_row_has_arrived() -> None:
    view = Drawn()
    feed = ViewFeed(SCENARIO, view)  # type: ignore[arg-type]
    delivery = np.zeros(1, TYPES["controller_delivery"])
    delivery["t_ns"] = delivery["model_t_ns"] = 100 * MS
    delivery["sequence"] = 5
    delivery["input"] = 50
    feed.add("controller_delivery", delivery)
    feed.add("controller_step", ticks(0, 50))
    feed.advance()
    assert view.forced == []

    packet = np.zeros(1, TYPES["netem_packet"])
    update = Message(Flow.UPDATE, 5, 100 * MS, np.zeros(LOOP.n))
    packet["head"] = np.void(Encoder(1, bytes(32)).encode(update)[:PACKET_HEAD_BYTES])
    packet["fate"] = Fate.FORCED
    feed.add("netem_packet", packet)
    feed.add("controller_step", ticks(51, 300))
    feed.advance()
    assert view.forced == [(100 * MS, True)]


def test_rows_that_are_drawn_or_not_shown_are_discarded() -> None:
    feed = ViewFeed(SCENARIO, Drawn())  # type: ignore[arg-type]
    given: list[weakref.ref[np.ndarray]] = []
    for batch in range(40):
        for table, dtype in TYPES.items():
            rows = np.zeros(25, dtype)
            rows["input"] = rows["sequence"] = 25 * batch + np.arange(25)
            rows["t_ns"] = rows["now_ns"] = rows["input"] * 2 * MS
            if "model_t_ns" in (dtype.names or ()):
                rows["model_t_ns"] = rows["t_ns"]
            given.append(weakref.ref(rows))
            feed.add(table, rows)
        feed.advance()
    gc.collect()
    assert sum(kept() is not None for kept in given) < 20


def test_the_plants_internal_state_is_shown_at_the_measurement_times(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """For any order of plant and sensor batches; without a row in time the state is unknown."""
    types = tables(LOOP.n, LOOP.m, internal=3)
    monkeypatch.setattr(cosim.output.viewer.table_feed, "tables_of", lambda scenario: types)
    view = Drawn()
    feed = ViewFeed(SCENARIO, view)  # type: ignore[arg-type]
    for first, count in ((0, 400), (400, 350)):
        steps = np.zeros(count, types["plant_step"])
        steps["t_ns"] = steps["now_ns"] = 2 * MS * (first + np.arange(count))
        steps["z"] = (first + np.arange(count))[:, None] + [0.0, 0.25, 0.5]
        feed.add("plant_step", steps)
        measurements = np.zeros(400, types["sensor_measurement"])
        measurements["t_ns"] = measurements["now_ns"] = 2 * MS * (first + np.arange(400))
        measurements["event"] = -1
        feed.add("sensor_measurement", measurements)
        feed.add("controller_step", ticks(first, 400))
        feed.advance(final=first > 0)
    t_ns = np.concatenate([times for times, _ in view.frames])
    z = np.concatenate([frames.z for _, frames in view.frames if frames.z is not None])
    np.testing.assert_array_equal(t_ns, 2 * MS * np.arange(800))
    np.testing.assert_array_equal(z[:750, 1], np.arange(750) + 0.25)
    assert np.isnan(z[750:]).all()
