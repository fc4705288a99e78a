"""The recorder of fates; its traces, damaged or not; and the replay, which repeats them."""

import json
import resource
import threading
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from netem.fates import METADATA, FateRecorder, read_fates
from netem.relay.relay_reports import EVENT
from netem.tc_words import settings_of
from noack.core.errors import CallerError
from noack.impairments.link_settings import Decisions, LinkSettings
from noack.protocol.record_tables import Fate
from tests.fuzz.parsers.fates import DOCUMENT, TABLE
from tests.helpers.approved import compare_lines, lines_of_error
from tests.netem.fate_links import MAX_GAP_NS, Arrival, Run, arrivals, drive, record, spec_of
from tests.noack.impairments.any_link_settings import harsh
from tests.oracles.link import Link

NOTHING = np.zeros(0, np.uint8)
LINK = settings_of("corrupt 50% mansd 2")


def arrived(count: int, link: int = 0, direction: int = 0, first: int = 0) -> NDArray[Any]:
    events = np.zeros(count, EVENT)
    events["packet"] = np.arange(first, first + count)
    events["link"], events["direction"] = link, direction
    for name in ("bit", "copy_bit", "copy_delay_ns"):
        events[name] = -1
    return events


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "fates.parquet"


def test_the_file_contains_the_description_of_its_links(path: Path) -> None:
    record(path, LINK, [])
    document = json.loads(pq.ParquetFile(path).metadata.metadata[METADATA.encode()])
    assert document["missing_events"] == 0
    (link,) = document["links"]
    assert (link["name"], link["seed"]) == ("a", 7)
    assert LinkSettings.model_validate_json(json.dumps(link["forward"])) == LINK
    with pytest.raises(CallerError, match="has no link 'b'; its links: a"):
        read_fates(path, ["b"])


def test_directions_are_separate_and_a_flow_may_have_packets_in_only_one(path: Path) -> None:
    """There are more rows than a group of the file has."""
    many = 70_000
    back = arrived(2, direction=1)
    back["flow"] = 1
    back["fate"], back["delay_ns"] = Fate.DROPPED, -1
    other = arrived(1)
    other["flow"] = 1
    with FateRecorder(path, [spec_of(LINK), spec_of(LINK, "up")]) as recorder:
        recorder.take(np.concatenate([arrived(3), other, back]), NOTHING)
        for first in range(3, many, 1000):
            recorder.take(arrived(min(1000, many - first), first=first), NOTHING)
    assert (recorder.rows, recorder.missing_events) == (many + 3, 0)
    assert pq.ParquetFile(path).metadata.num_row_groups > 1
    fates = read_fates(path).decisions
    assert {key: [len(flow) for flow in flows] for key, flows in fates.items()} == {
        ("a", "forward"): [many, 1],
        ("a", "reverse"): [0, 2],
        ("up", "forward"): [],
        ("up", "reverse"): [],
    }
    assert [fate for fate, *_ in fates["a", "reverse"][1]] == [Fate.DROPPED] * 2
    assert set(read_fates(path, ["up"]).decisions) == {("up", "forward"), ("up", "reverse")}


@pytest.mark.parametrize(
    ("words", "losses", "is_kept"),
    [
        ("mansd 2", (1, 1, 0), True), ("mansd 2", (1, 1, 1), False),
        ("atmost 1 in 3", (1, 0, 0, 1), True), ("atmost 1 in 3", (1, 0, 1), False),
    ],
)  # fmt: skip
def test_a_trace_has_the_guarantee_of_its_link_if_its_losses_keep_it(
    path: Path, words: str, losses: tuple[int, ...], is_kept: bool
) -> None:
    """They do not if the guarantee changed during the recording."""
    events, burst = arrived(len(losses)), 0
    for event, is_lost in zip(events, losses, strict=True):
        burst = (burst + 1) * is_lost
        event["consecutive_losses"] = burst
        event["fate"], event["delay_ns"] = (Fate.DROPPED, -1) if is_lost else (Fate.DELIVERED, 0)
    link = settings_of(words)
    with FateRecorder(path, [spec_of(link)]) as recorder:
        recorder.take(events, NOTHING)
    guarantee = {"mansd": link.mansd, "constraints": link.constraints}
    assert read_fates(path).guarantees["a", "forward"] == (guarantee if is_kept else {})


def test_events_beyond_the_queue_limit_are_reported_missing_at_once(
    path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    free = threading.Event()
    write_table = pq.ParquetWriter.write_table

    def slow(self: pq.ParquetWriter, table: pa.Table) -> None:
        assert free.wait(60)
        write_table(self, table)

    monkeypatch.setattr(pq.ParquetWriter, "write_table", slow)
    with FateRecorder(path, [spec_of(LINK)], max_waiting=100_000) as recorder:
        recorder.take(arrived(100_000), NOTHING)
        recorder.take(arrived(7), NOTHING)  # returns at once, although the write is blocked
        assert recorder.missing_events == 7
        recorder.add_missing(2)  # events that the relay lost
        free.set()
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "events are missing" in error
    with pytest.raises(CallerError, match="9 events are missing; an incomplete trace"):
        read_fates(path)


def test_the_relay_continues_if_the_file_cannot_grow(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        with FateRecorder(path, [spec_of(LINK)]) as recorder:
            for first in range(0, 300_000, 100_000):
                recorder.take(arrived(100_000, first=first), NOTHING)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "cannot be written (File too large)" in error
    assert (recorder.rows, recorder.missing_events) == (0, 300_000)
    with pytest.raises(CallerError, match="incomplete because"):
        read_fates(path)


def test_a_file_that_cannot_be_created_is_reported_at_once(tmp_path: Path) -> None:
    with pytest.raises(CallerError, match=r"none/x: cannot be written \(No such file"):
        FateRecorder(tmp_path / "none" / "x", [spec_of(LINK)])
    with pytest.raises(CallerError, match=r"cannot be written \(No space left on device\)"):
        FateRecorder(Path("/dev/full"), [spec_of(LINK)])


def write(path: Path, table: pa.Table, document: object = DOCUMENT) -> Path:
    pq.write_table(table.replace_schema_metadata({METADATA: json.dumps(document)}), path)
    return path


def with_first(column: str, value: int | None) -> pa.Table:
    """Return the trace with another value in the first row."""
    at = TABLE.column_names.index(column)
    field = TABLE.schema.field(at)
    values = [value, *TABLE[column].to_pylist()[1:]]
    return TABLE.set_column(at, field, pa.array(values, field.type))


def test_a_wrong_trace_is_refused_with_the_approved_line(path: Path) -> None:
    """A line has a key that is left out, other keys, the rows that are left, or another value."""

    def refusal(line: str) -> list[str]:
        table, given = TABLE, json.loads(line)
        document: Any = DOCUMENT
        if given is None:
            document = None
        elif given.keys() <= DOCUMENT.keys():
            document = DOCUMENT | given
        elif "without" in given:
            document = {key: value for key, value in DOCUMENT.items() if key != given["without"]}
        elif "reverse" in given:
            document = DOCUMENT | {"links": [DOCUMENT["links"][0] | given]}
        elif "rows" in given:
            table = TABLE.take(given["rows"])
        else:
            table = with_first(*given["first"])
        return lines_of_error(lambda: read_fates(write(path, table, document)), FILE=path)

    assert len(read_fates(write(path, TABLE)).decisions["up", "forward"]) == 2
    compare_lines(Path(__file__).with_name("fate_mistakes.txt"), refusal)


def test_files_that_are_no_fate_traces_are_refused(path: Path, tmp_path: Path) -> None:
    with pytest.raises(CallerError, match=r"cannot be read \(.*No such file"):
        read_fates(tmp_path / "none")
    with pytest.raises(CallerError, match="cannot be read"):
        read_fates(tmp_path)
    path.write_text("fates")
    with pytest.raises(CallerError, match="not a fate trace, or incomplete"):
        read_fates(path)
    pq.write_table(pa.table({"a": [1]}), path)
    with pytest.raises(CallerError, match="not a fate trace of this program"):
        read_fates(path)


BAD = settings_of(
    "loss gemodel 20% 40% duplicate 40% corrupt 40% delay 100us 100us rate 50mbit queue 3 mansd 3 limit 12"
)
"""Every impairment acts, frequently."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fates")


def fates_of(folder: Path) -> Decisions:
    return read_fates(folder / "fates.parquet").decisions["a", "forward"]


def observable(run: Run) -> list[tuple[int, ...]]:
    """Return the values that the sender and the receiver can observe."""
    values_of = attrgetter("fate", "packet", "consecutive_losses", "release_ns", "copy_ns", "bit", "copy_bit")
    return list(map(values_of, run.decisions))


@given(harsh.filter(lambda link: not link.chooses), arrivals, st.booleans())
def test_the_same_arrivals_have_the_same_fates(
    folder: Path, link: LinkSettings, sent: list[Arrival], capped: bool
) -> None:
    """The fates do not depend on the replaying link: another seed, no impairments."""
    before = record(folder / "fates.parquet", link, sent)
    bare = LinkSettings(mansd=link.mansd) if capped else LinkSettings()
    for replaying in (link, bare):
        again = drive(Link(replaying, 8, "b", decisions=fates_of(folder)), sent)
        assert observable(again) == observable(before)
        assert again.departures == before.departures


@given(harsh.filter(lambda link: not link.chooses), arrivals, st.data())
def test_at_other_times_the_delays_are_the_same(
    folder: Path, link: LinkSettings, sent: list[Arrival], data: st.DataObject
) -> None:
    """tests/noack/impairments/test_mansd.py checks that the replay keeps the cap."""
    before = record(folder / "fates.parquet", link, sent)
    gaps = st.lists(st.integers(0, MAX_GAP_NS), min_size=len(sent), max_size=len(sent))
    mansd = data.draw(st.sampled_from([link.mansd, 0, 1, 2]))
    moved = [arrival._replace(gap_ns=gap) for arrival, gap in zip(sent, data.draw(gaps), strict=True)]
    replaying = link.model_copy(update={"mansd": mansd})
    again = drive(Link(replaying, 8, "b", decisions=fates_of(folder)), moved)
    for old, old_arrival, new, new_arrival in zip(
        before.decisions, before.arrivals, again.decisions, again.arrivals, strict=True
    ):
        if old.fate == new.fate and old.release_ns >= 0:
            delay_ns = new.release_ns - new_arrival[0]
            assert delay_ns >= old.release_ns - old_arrival[0]
            assert new.hold_back_ns or delay_ns == old.release_ns - old_arrival[0]
        lost = (Fate.DROPPED, Fate.CORRUPTED, Fate.OVERFLOWED, Fate.BLACKED_OUT)
        assert old.fate == new.fate or (old.fate in lost and new.fate == Fate.FORCED)


@given(arrivals, st.data())
def test_a_bit_that_a_datagram_does_not_have_is_not_flipped(
    folder: Path, sent: list[Arrival], data: st.DataObject
) -> None:
    broken = settings_of("corrupt 100%")
    record(folder / "fates.parquet", broken, sent)
    sizes = st.lists(st.integers(0, 40), min_size=len(sent), max_size=len(sent))
    other = [
        arrival._replace(size_bytes=size_bytes)
        for arrival, size_bytes in zip(sent, data.draw(sizes), strict=True)
    ]
    again = drive(Link(broken, 8, "b", decisions=fates_of(folder)), other)
    for was, now, decision in zip(sent, other, again.decisions, strict=True):
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
