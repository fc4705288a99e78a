"""A replay repeats the recorded fates."""

from operator import attrgetter
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from netem.fates import read_fates
from netem.tc_words import settings_of
from noack.impairments.link_settings import Decisions, LinkSettings
from noack.protocol.record_tables import Fate
from tests.netem.any_settings import harsh as settings
from tests.netem.fates.links import MAX_GAP_NS, Arrival, Run, arrivals, drive, record
from tests.oracles.link import Link

BAD = settings_of(
    "loss gemodel 20% 40% duplicate 40% corrupt 40% delay 100us 100us rate 50mbit queue 3 "
    "mansd 3 limit 12"
)
"""Every impairment acts, frequently."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fates")


def fates_of(folder: Path) -> Decisions:
    return read_fates(folder / "fates.parquet").decisions["a", "forward"]


def seen(run: Run) -> list[tuple[int, ...]]:
    """Return the values that the sender and the receiver can observe."""
    observable = attrgetter(
        "fate", "packet", "consecutive_losses", "release_ns", "copy_ns", "bit", "copy_bit"
    )
    return list(map(observable, run.decisions))


@given(settings, arrivals, st.booleans())
def test_the_same_arrivals_have_the_same_fates(
    folder: Path, link: LinkSettings, came: list[Arrival], capped: bool
) -> None:
    """The fates do not depend on the replaying link: another seed, no impairments."""
    before = record(folder / "fates.parquet", link, came)
    bare = LinkSettings(mansd=link.mansd) if capped else LinkSettings()
    for replaying in (link, bare):
        again = drive(Link(replaying, 8, "b", decisions=fates_of(folder)), came)
        assert seen(again) == seen(before)
        assert again.departures == before.departures


@given(settings, arrivals, st.data())
def test_at_other_times_the_delays_are_the_same(
    folder: Path, link: LinkSettings, came: list[Arrival], data: st.DataObject
) -> None:
    """tests/netem/test_mansd.py checks that the replay keeps the cap."""
    before = record(folder / "fates.parquet", link, came)
    gaps = st.lists(st.integers(0, MAX_GAP_NS), min_size=len(came), max_size=len(came))
    mansd = data.draw(st.sampled_from([link.mansd, 0, 1, 2]))
    moved = [one._replace(gap_ns=gap) for one, gap in zip(came, data.draw(gaps), strict=True)]
    replaying = link.model_copy(update={"mansd": mansd})
    again = drive(Link(replaying, 8, "b", decisions=fates_of(folder)), moved)
    for old, old_came, new, new_came in zip(
        before.decisions, before.arrivals, again.decisions, again.arrivals, strict=True
    ):
        if old.fate == new.fate and old.release_ns >= 0:
            delay_ns = new.release_ns - new_came[0]
            assert delay_ns >= old.release_ns - old_came[0]
            assert new.hold_back_ns or delay_ns == old.release_ns - old_came[0]
        lost = (Fate.DROPPED, Fate.CORRUPTED, Fate.OVERFLOWED, Fate.BLACKED_OUT)
        assert old.fate == new.fate or (old.fate in lost and new.fate == Fate.FORCED)


@given(arrivals, st.data())
def test_a_bit_that_a_datagram_does_not_have_is_not_flipped(
    folder: Path, came: list[Arrival], data: st.DataObject
) -> None:
    broken = settings_of("corrupt 100%")
    record(folder / "fates.parquet", broken, came)
    sizes = st.lists(st.integers(0, 40), min_size=len(came), max_size=len(came))
    other = [
        arrival._replace(size_bytes=size_bytes)
        for arrival, size_bytes in zip(came, data.draw(sizes), strict=True)
    ]
    again = drive(Link(broken, 8, "b", decisions=fates_of(folder)), other)
    for was, now, decision in zip(came, other, again.decisions, strict=True):
        corrupted = was.size_bytes > 0 and now.size_bytes > 0
        assert decision.fate == (Fate.CORRUPTED if corrupted else Fate.DELIVERED)
        assert (0 <= decision.bit < 8 * now.size_bytes) == corrupted


def test_packets_that_are_not_in_the_trace_use_the_links_own_settings(folder: Path) -> None:
    record(folder / "fates.parquet", BAD, [Arrival(1000, 0, 8)] * 5)
    link = Link(settings_of("loss worst"), 8, "b", decisions=fates_of(folder))
    again = drive(link, [Arrival(1000, 0, 8)] * 8 + [Arrival(1000, 1, 8)] * 3)
    fates = [decision.fate for decision in again.decisions]
    assert fates[5:] == [Fate.DROPPED] * 6
    assert fates[:5] != [Fate.DROPPED] * 5
