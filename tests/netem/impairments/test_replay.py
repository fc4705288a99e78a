"""Replayed traces: each packet gets what was recorded for its number or its time."""

from bisect import bisect_right
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from netem.impairments.kinds.replay import Replay
from netem.impairments.link_settings import LinkSettings
from netem.impairments.target_loss import read_files
from netem.tc_words import settings_of
from netem.traces.packet_trace import read_trace
from tests.netem.stepped_link import Link

CICV5G = Path(__file__).parents[3] / "netem/traces/shipped/cicv5g"
MS = 10**6
records = st.lists(
    st.tuples(st.integers(0, 40 * MS), st.just(-1) | st.integers(0, 90 * MS)),
    min_size=1, max_size=12,
).map(lambda steps: [(0, steps[0][1]), *steps[1:]])  # fmt: skip


def replay(steps: list[tuple[int, int]], **given: Any) -> Replay:
    sent_ns = np.cumsum([gap for gap, _ in steps]).tolist()
    delays_ns = tuple(delay for _, delay in steps)
    return Replay(sent_ns=tuple(sent_ns), delays_ns=delays_ns, **given)


def outcomes(link: Link, arrivals_ns: list[int], flow: int = 0) -> list[int]:
    """Return each packet's delay, or −1 if it is lost."""
    decisions = []
    for now_ns in arrivals_ns:
        decision = link.decide(flow, 100, now_ns)
        decisions.append(-1 if decision.release_ns < 0 else decision.release_ns - now_ns)
    return decisions


def link_of(*impairments: Replay, seed: int = 0, **given: Any) -> Link:
    return Link(LinkSettings(impairments=impairments, limit=10**6, **given), seed, "test")


@given(records, st.booleans(), st.integers(0, 30))
def test_packet_k_of_each_flow_gets_record_k(steps: Any, repeat: bool, first: int) -> None:
    settings = replay(steps, repeat=repeat)
    sent_ns, n = settings.sent_ns or (), len(steps)
    offset_ns = first * settings.length_ns // 31
    before = sum(at < offset_ns for at in sent_ns)
    link = link_of(settings.model_copy(update={"offset_s": offset_ns / 1e9}))
    expected = [steps[(before + k) % n][1] if repeat or before + k < n else 0 for k in range(25)]
    for flow in (0, 1):
        assert outcomes(link, [7 * MS * k for k in range(25)], flow) == expected


@given(records, st.booleans(), st.lists(st.integers(0, 10**9), max_size=20))
def test_by_time_a_packet_gets_what_was_recorded_at_its_time(
    steps: Any, repeat: bool, arrivals: list[int]
) -> None:
    settings = replay(steps, by="time", repeat=repeat)
    sent_ns, length_ns = list(settings.sent_ns or ()), settings.length_ns
    arrivals = sorted(arrivals) + [length_ns + at for at in sent_ns]
    delays_ns = outcomes(link_of(settings), sorted(arrivals))
    for now_ns, delay_ns in zip(sorted(arrivals), delays_ns, strict=True):
        t = now_ns % length_ns
        k = bisect_right(sent_ns, t) - 1
        here = steps[k][1]
        following = steps[k + 1][1] if k + 1 < len(steps) else -1
        if not repeat and now_ns >= length_ns:
            assert delay_ns == 0
        elif here < 0 or following < 0:
            assert delay_ns == here
        else:
            share = Fraction(t - sent_ns[k], sent_ns[k + 1] - sent_ns[k])
            assert 0 <= here + share * (following - here) - delay_ns < 1


def test_a_packet_that_must_pass_has_the_delay_of_the_last_that_was_received() -> None:
    """A share of the delay may be applied; losses remain."""
    steps = [(0, 30 * MS), (MS, -1), (MS, -1), (MS, 5 * MS)]
    link = link_of(replay(steps, delay_share=0.5), mansd=1)
    delays_ns = outcomes(link, [k * 100 * MS for k in range(4)])
    assert delays_ns == [15 * MS, -1, 15 * MS, 5 * MS // 2]


def test_a_random_place_is_drawn_by_the_seed_for_all_flows_uniformly() -> None:
    steps = [(0 if k == 0 else MS, k * MS) for k in range(10)]
    first = []
    for seed in range(600):
        link = link_of(replay(steps, offset_s="random"), seed=seed)
        begins = {outcomes(link, [0, 0], flow)[0] for flow in range(3)}
        assert len(begins) == 1
        first += begins
    counts = np.bincount(np.array(first) // MS, minlength=10)
    assert counts.sum() == 600
    assert counts.min() > 23  # of 60 expected, five standard deviations
    by_time = [link_of(replay(steps, offset_s="random", by="time"), seed=k) for k in (3, 4)]
    assert outcomes(by_time[0], [0]) != outcomes(by_time[1], [0])


@pytest.mark.parametrize("path", sorted(CICV5G.glob("*.csv")), ids=lambda path: path.stem)
def test_a_shipped_trace_is_reproduced_packet_by_packet(decide: Any, path: Path) -> None:
    """At the source's rate, each packet of two rounds is received when it was recorded."""
    trace = read_trace(path)
    settings = read_files(settings_of(f"replay {path} limit 100000"), Path())
    (replay,) = settings.impairments
    assert isinstance(replay, Replay)
    sent_ns = np.concatenate([trace.sent_ns, replay.length_ns + trace.sent_ns])
    expected = np.concatenate([trace.received_ns, replay.length_ns + trace.received_ns])
    for words in (
        settings,
        settings.model_copy(update={"impairments": (replay.model_copy(update={"by": "time"}),)}),
    ):
        decided = decide(words, len(sent_ns), arrivals_ns=sent_ns)
        # By time, the last of several packets that were sent at once counts.
        repeated = np.diff(sent_ns, append=sent_ns[-1] + 1) == 0
        assert (decided.decisions["release_ns"] == expected)[~repeated].all()
