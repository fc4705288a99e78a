import json
import resource
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from numpy.typing import NDArray

from netem.fates import METADATA, FateRecorder, read_fates
from netem.relay_links import EVENT
from netem.tc_words import settings_of
from noack.core.errors import CallerError
from noack.impairments.link_settings import LinkSettings
from noack.protocol.record_tables import Fate
from tests.netem.fates.links import record, spec_of

NOTHING = np.zeros(0, np.uint8)
LINK = settings_of("corrupt 50% mansd 2")


def arrivals(count: int, link: int = 0, direction: int = 0, first: int = 0) -> NDArray[Any]:
    events = np.zeros(count, EVENT)
    events["packet"] = np.arange(first, first + count)
    events["link"], events["direction"] = link, direction
    for name in ("bit", "copy_bit", "copy_delay_ns"):
        events[name] = -1
    return events


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "fates.parquet"


def test_a_row_contains_the_fields_of_its_event(path: Path) -> None:
    event = arrivals(1, link=1, direction=1)
    fields = {
        "t_ns": 1_790_000_000_123_456_789, "size_bytes": 1400, "fate": Fate.CORRUPTED,
        "consecutive_losses": 2,
        "delay_ns": 5, "copy_delay_ns": 2**40, "bit": 17, "copy_bit": 11_199, "hold_back_ns": 3,
    }  # fmt: skip
    for name, value in fields.items():
        event[name] = value
    with FateRecorder(path, [spec_of(LINK), spec_of(LINK, "up")]) as recorder:
        recorder.take(event, NOTHING)
    (row,) = pq.read_table(path).to_pylist()
    arrival_ns = fields.pop("t_ns")
    assert row == fields | {
        "link": "up", "direction": "reverse", "flow": 0, "packet": 0,
        "arrival_ns": arrival_ns,
    }  # fmt: skip


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
    back = arrivals(2, direction=1)
    back["flow"] = 1
    back["fate"], back["delay_ns"] = Fate.DROPPED, -1
    other = arrivals(1)
    other["flow"] = 1
    with FateRecorder(path, [spec_of(LINK), spec_of(LINK, "up")]) as recorder:
        recorder.take(np.concatenate([arrivals(3), other, back]), NOTHING)
        for first in range(3, many, 1000):
            recorder.take(arrivals(min(1000, many - first), first=first), NOTHING)
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
        recorder.take(arrivals(100_000), NOTHING)
        recorder.take(arrivals(7), NOTHING)  # returns at once, although the write is blocked
        assert recorder.missing_events == 7
        recorder.missing(2)  # events that the relay lost
        free.set()
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "events are missing" in error
    with pytest.raises(CallerError, match="9 events are missing; an incomplete trace"):
        read_fates(path)


def test_the_relay_continues_if_the_file_cannot_grow(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        with FateRecorder(path, [spec_of(LINK)]) as recorder:
            for first in range(0, 300_000, 100_000):
                recorder.take(arrivals(100_000, first=first), NOTHING)
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
