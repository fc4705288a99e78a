"""Batches of different processes reach the feed in any order; the view shows them joined."""

from pathlib import Path
from typing import Any

import numpy as np

from cosim.viewer.feed import ViewFeed
from noack.records import PACKET_HEAD_BYTES, Fate, tables
from noack.resolve import loop_of, resolve
from noack.scenario_file import load
from noack.wire import Encoder, Flow, Message

ROOT = Path(__file__).parents[3]
SCENARIO = resolve(load(ROOT / "scenarios" / "lane_following.toml"))
LOOP = loop_of(SCENARIO)
TYPES = tables(LOOP.n, LOOP.m)
MS = 1_000_000


class Drawn:
    """A view that keeps what it is given."""

    def __init__(self) -> None:
        self.forced: list[tuple[int, bool]] = []

    def receptions(self, t_ns: Any, interval_s: Any, forced: Any) -> None:
        self.forced += list(zip(t_ns.tolist(), forced.tolist(), strict=True))

    def __getattr__(self, name: str) -> Any:
        return lambda *arguments: None


def ticks(first: int, count: int) -> np.ndarray:
    rows = np.zeros(count, TYPES["controller_step"])
    rows["input"] = rows["sequence"] = np.arange(first, first + count)
    rows["t_ns"] = rows["model_t_ns"] = rows["now_ns"] = rows["input"] * 2 * MS
    return rows


def test_a_delivery_waits_for_the_networks_word_on_it() -> None:
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
