import errno
import os
import resource
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from netem.capture import CaptureWriter, PcapngSection
from netem.relay_links import Bytes, Events
from noack.core.errors import CallerError
from tests.netem.capture.batches import SPECS, batch, file_of
from tests.netem.capture.reader import read

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


def test_the_file_holds_the_batches(tmp_path: Path) -> None:
    path = tmp_path / "capture.pcapng"
    path.write_bytes(b"an older capture" * 1000)
    with capturing(path) as capture:
        for event in FOUR:
            events, data = batch(event)
            data = data.copy()
            capture.take(events, data)
            events["packet"], data[:] = 9, 0  # the relay reuses these arrays
    assert path.read_bytes() == file_of(*FOUR)
    assert (capture.error, capture.missing_events, capture.written) == (None, 0, 4)
    capture.take(*batch({}))
    assert capture.missing_events == 1


def test_events_that_overflow_the_queue_are_reported_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "capture.pcapng"
    free, begun = threading.Event(), threading.Event()
    packets = PcapngSection.packets

    def slow(self: PcapngSection, events: Events, data: Bytes) -> memoryview:
        if events.size:
            begun.set()
            assert free.wait(PATIENCE_S)
        return packets(self, events, data)

    monkeypatch.setattr(PcapngSection, "packets", slow)
    with capturing(path, batches=2) as capture:
        capture.take(*batch({}))
        assert begun.wait(PATIENCE_S)  # the writer is busy, the queue empty
        capture.take(*batch({}))
        capture.take(*batch({}))
        assert capture.missing_events == 0
        capture.take(*batch({}, {}))
        capture.take(*batch({"interface": 1}))
        assert capture.missing_events == 3
        free.set()
        while capture.written < 3:
            pass
        capture.take(*batch({"interface": 1}, {"interface": 1}, {}))
    assert (capture.missing_events, capture.written, capture.error) == (3, 6, None)
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
    assert (capture.written, capture.missing_events) == (17, 23)
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
    assert capture.missing_events == 3 - capture.written > 0
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
