"""Captures, which ``reader`` reads independently of the code; and the thread that writes them."""

import errno
import json
import os
import resource
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from netem.capture import CaptureWriter, Interface, PcapngSection
from netem.relay.relay_reports import DIRECTIONS, EVENT, Bytes, Events
from noack.core.errors import CallerError
from tests.helpers.approved import compare_lines
from tests.helpers.waiting import wait_for
from tests.netem.capture_reader import (
    INTERFACES,
    SPECS,
    T_NS,
    Datagram,
    batch,
    datagram,
    events,
    file_of,
    read,
)

pytestmark = pytest.mark.sanitized


@given(st.lists(events, max_size=5))
def test_an_independent_reader_finds_what_was_written(described: list[dict[str, Any]]) -> None:
    section, interfaces, packets, _ = read(file_of(*described))
    assert section[4][0].startswith(b"noack netem ")
    assert [(kind, snap) for kind, snap, _ in interfaces] == [(101, 262_144)] * 2
    assert [options for _, _, options in interfaces] == [
        {2: [name.encode()], 3: [at.encode()], 9: [b"\x09"]} for name, at in INTERFACES
    ]
    assert len(packets) == len(described)
    for packet, event in zip(packets, described, strict=True):
        assert packet.interface == event["interface"]
        assert packet.t_ns == event["t_ns"]
        assert packet.original_bytes == len(packet.frame)
        assert packet.options[2] == [struct.pack("<I", 2 if event["departure"] else 1)]
        names = ("source", "destination", "source_port", "destination_port", "payload")
        assert datagram(packet.frame) == Datagram(*(event[name] for name in names))
        name = DIRECTIONS[event["direction"]]
        assert packet.comment.endswith(f"; {name}, flow {event['flow']}, packet {event['packet']}")


@given(st.lists(events, max_size=6), st.integers(0, 6))
@settings(max_examples=30)
def test_the_file_does_not_depend_on_batching_or_old_memory(
    described: list[dict[str, Any]], cut: int
) -> None:
    whole = file_of(*described)
    section = PcapngSection(INTERFACES)
    parts = section.header()
    for part in (described[:cut], described[cut:]):
        table, data = batch(*part)
        section._out = np.full(300_000, 0xA5, np.uint8)
        parts += bytes(section.packets(table, data))
    assert parts + section.statistics() == whole


def test_each_fate_has_the_approved_comment() -> None:
    def comment(fields: str) -> list[str]:
        (packet,) = read(file_of(json.loads(fields))).packets
        return [packet.comment]

    compare_lines(Path(__file__).with_name("capture_comments.txt"), comment)


def test_a_checksum_of_0_is_sent_as_ffff() -> None:
    """RFC 768: a checksum field of 0 means that there is no checksum."""

    def frame_of(payload: bytes) -> bytes:
        return read(file_of({"payload": payload})).packets[0].frame

    checksum = frame_of(bytes(2))[26:28]
    frame = frame_of(checksum)  # the sum becomes all ones
    assert frame[26:28] == b"\xff\xff"
    assert datagram(frame).payload == checksum


@pytest.mark.parametrize(("family", "most"), [(4, 65_507), (6, 65_527)])
def test_a_capture_holds_the_largest_datagram(family: int, most: int) -> None:
    table, data = batch({"family": family, "payload": bytes(most)})
    section = PcapngSection(INTERFACES)
    file = read(section.header() + bytes(section.packets(table, data)))
    assert len(datagram(file.packets[0].frame).payload) == most
    table["size_bytes"] += 1
    with pytest.raises(ValueError, match="too large for a datagram"):
        section.packets(table, np.append(data, np.uint8(0)))


@given(events, st.data())
def test_events_of_any_numbers_are_refused_or_written(described: dict[str, Any], data: st.DataObject) -> None:
    table, payload = batch({}, described)
    fields = data.draw(st.lists(st.sampled_from(EVENT.names), max_size=3, unique=True))
    for name in fields:
        low, high = (getattr(np.iinfo(EVENT[name].base), end) for end in ("min", "max"))
        table[name][1] = data.draw(st.one_of(st.integers(0, 8), st.integers(low, high)))
    section = PcapngSection(INTERFACES)
    with suppress(ValueError):
        packets = read(section.header() + bytes(section.packets(table, payload))).packets
        assert packets[1].comment.endswith(f", packet {table['packet'][1]}")


def test_missing_events_are_reported_at_their_place_and_at_the_end() -> None:
    section = PcapngSection((INTERFACES[0], Interface("link0 server", "")))
    data = section.header()
    data += bytes(section.packets(*batch({}, {"interface": 1})))
    section.add_missing(np.array([0, 2**33 + 5]))
    data += bytes(section.packets(*batch({}, {"interface": 1}, {"interface": 1, "t_ns": T_NS + 7})))
    section.add_missing(np.array([4, 0]))
    file = read(data + section.statistics())
    counts = [packet.options.get(4) for packet in file.packets]
    assert counts == [None, None, None, [struct.pack("<Q", 2**33 + 5)], None]
    received_and_dropped = {
        index: [struct.unpack("<Q", options[code][0])[0] for code in (4, 5)]
        for index, (_, options) in file.statistics.items()
    }
    assert received_and_dropped == {0: [2 + 4, 4], 1: [3 + 2**33 + 5, 2**33 + 5]}
    for t_ns, options in file.statistics.values():
        ends = [struct.unpack("<II", options[code][0]) for code in (2, 3)]
        assert [high << 32 | low for high, low in ends] == [T_NS, T_NS + 7]
        assert t_ns == T_NS + 7


FOUR = [{"packet": number, "interface": number % 2} for number in range(4)]
PATIENCE_S = 60.0


@pytest.fixture
def fifo(tmp_path: Path) -> Iterator[tuple[Path, int]]:
    """A FIFO and its read end; nothing reads from it unless a test does."""
    path = tmp_path / "fifo"
    os.mkfifo(path)
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    os.set_blocking(descriptor, True)
    yield path, descriptor
    os.close(descriptor)


@contextmanager
def capturing(path: Path | str, **options: int) -> Iterator[CaptureWriter]:
    capture = CaptureWriter(path, SPECS, **options)
    try:
        yield capture
    finally:
        capture.close()


def test_a_new_capture_replaces_an_older_file(tmp_path: Path) -> None:
    path = tmp_path / "capture.pcapng"
    path.write_bytes(b"an older capture" * 1000)
    with capturing(path) as capture:
        for event in FOUR:
            events, data = batch(event)
            data = data.copy()
            capture.take(events, data)
            events["packet"], data[:] = 9, 0  # the relay reuses these arrays
    assert path.read_bytes() == file_of(*FOUR)
    assert (capture.error, capture.missing_events, capture.written_events) == (None, 0, 4)
    capture.take(*batch({}))
    capture.close()
    assert capture.missing_events == 1


def test_events_that_overflow_the_queue_are_reported_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "capture.pcapng"
    free, writing_started = threading.Event(), threading.Event()
    packets = PcapngSection.packets

    def slow(self: PcapngSection, events: Events, data: Bytes) -> memoryview:
        if events.size:
            writing_started.set()
            assert free.wait(PATIENCE_S)
        return packets(self, events, data)

    monkeypatch.setattr(PcapngSection, "packets", slow)
    with capturing(path, batches=2) as capture:
        capture.take(*batch({}))
        assert writing_started.wait(PATIENCE_S)  # the writer is busy, the queue empty
        capture.take(*batch({}))
        capture.take(*batch({}))
        assert capture.missing_events == 0
        capture.take(*batch({}, {}))
        capture.take(*batch({"interface": 1}))
        assert capture.missing_events == 3
        free.set()
        wait_for(lambda: capture.written_events == 3)
        capture.take(*batch({"interface": 1}, {"interface": 1}, {}))
    assert (capture.missing_events, capture.written_events, capture.error) == (3, 6, None)
    drop_counts = [packet.options.get(4, [b""])[0] for packet in read(path.read_bytes()).packets]
    assert [int.from_bytes(count, "little") for count in drop_counts] == [0, 0, 0, 1, 0, 2]


def test_a_capture_that_a_full_disk_ends_can_be_read(tmp_path: Path) -> None:
    path = tmp_path / "capture.pcapng"
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, limits[1]))
    try:
        with capturing(path) as capture:
            for _ in range(40):
                capture.take(*batch({"payload": bytes(60_000)}))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert capture.error is not None
    assert capture.error.endswith(f"ends after 17 events: {os.strerror(errno.EFBIG)}")
    assert (capture.written_events, capture.missing_events) == (17, 23)
    assert len(read(path.read_bytes()).packets) == 17


def test_an_impossible_event_ends_the_capture(tmp_path: Path) -> None:
    with capturing(tmp_path / "capture.pcapng") as capture:
        capture.take(*batch({}))
        capture.take(*batch({"family": 5}))
    assert capture.error is not None
    assert "after 1 events: a batch is impossible" in capture.error
    assert len(read((tmp_path / "capture.pcapng").read_bytes()).packets) == 1


def test_a_reader_that_reads_nothing_does_not_delay_the_end(fifo: tuple[Path, int]) -> None:
    path, descriptor = fifo
    capture = CaptureWriter(path, SPECS)
    for _ in range(3):
        capture.take(*batch({"payload": bytes(60_000)}))
    capture.close(patience_s=0.05)
    assert capture.error is not None
    assert capture.error.endswith(": nothing could be written for 0.05 s")
    assert capture.missing_events == 3 - capture.written_events > 0
    while os.read(descriptor, 1 << 16):
        pass
    capture._thread.join(PATIENCE_S)
    assert not capture._thread.is_alive()


def test_a_path_that_cannot_be_opened_and_a_terminal_are_refused_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("missing/capture.pcapng", "."):
        with pytest.raises(CallerError, match="the capture cannot be opened: "):
            CaptureWriter(tmp_path / name, SPECS)
    monkeypatch.setattr(os, "isatty", lambda descriptor: descriptor == 1)
    with pytest.raises(CallerError, match="cannot go to a terminal"):
        CaptureWriter("-", SPECS)


def test_a_capture_can_be_written_to_standard_output(
    capfdbinary: pytest.CaptureFixture[bytes],
) -> None:
    with capturing("-") as capture:
        capture.take(*batch({}, {"flow": 5}))
    assert capture.error is None
    assert capfdbinary.readouterr().out == file_of({}, {"flow": 5})
