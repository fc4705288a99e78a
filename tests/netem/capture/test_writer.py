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
from tests.netem.capture.reader import Options, read

FOUR = [{"packet": number, "interface": number % 2} for number in range(4)]
PATIENCE_S = 60.0


@pytest.fixture
def fifo(tmp_path: Path) -> Path:
    path = tmp_path / "fifo"
    os.mkfifo(path)
    return path


@pytest.fixture
def reader(fifo: Path) -> Iterator[int]:
    """An open read end of the FIFO; nothing reads from it unless a test does."""
    descriptor = os.open(fifo, os.O_RDONLY | os.O_NONBLOCK)
    os.set_blocking(descriptor, True)
    yield descriptor
    os.close(descriptor)


def drain(descriptor: int) -> bytes:
    chunks = []
    while chunk := os.read(descriptor, 1 << 16):
        chunks.append(chunk)
    return b"".join(chunks)


@contextmanager
def capturing(path: Path | str, **options: int) -> Iterator[CaptureWriter]:
    capture = CaptureWriter(path, SPECS, **options)
    try:
        yield capture
    finally:
        capture.close()


def numbers(options: Options, *codes: int) -> list[int]:
    return [int.from_bytes(options[code][0], "little") for code in codes]


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
    file = read(path.read_bytes())
    drop_counts = [packet.options.get(4, [b""])[0] for packet in file.packets]
    assert [int.from_bytes(count, "little") for count in drop_counts] == [0, 0, 0, 1, 0, 2]
    assert [numbers(options, 4, 5) for _, options in file.statistics.values()] == [
        [4 + 2, 2], [2 + 1, 1],
    ]  # fmt: skip


def test_a_full_disk_ends_the_capture_in_one_line(tmp_path: Path) -> None:
    with capturing(Path("/dev/full")) as capture:
        capture.take(*batch(*FOUR))
        capture.close()
        capture.take(*batch(*FOUR))
    assert capture.error == (
        f"/dev/full: the capture ends after 0 events: {os.strerror(errno.ENOSPC)}"
    )
    assert (capture.missing_events, capture.written) == (8, 0)


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


def test_a_reader_that_closes_the_pipe_ends_the_capture(fifo: Path) -> None:
    descriptor = os.open(fifo, os.O_RDONLY | os.O_NONBLOCK)
    capture = CaptureWriter(fifo, SPECS)
    os.close(descriptor)
    capture.close()
    assert capture.error is not None
    assert capture.error.endswith(os.strerror(errno.EPIPE))


def test_a_reader_that_reads_nothing_does_not_delay_the_end(fifo: Path, reader: int) -> None:
    capture = CaptureWriter(fifo, SPECS)
    for _ in range(3):
        capture.take(*batch({"payload": bytes(60_000)}))
    capture.close(patience_s=0.05)
    assert capture.error is not None
    assert capture.error.endswith(": nothing could be written for 0.05 s")
    assert capture.missing_events == 3 - capture.written > 0
    drain(reader)
    capture._thread.join(PATIENCE_S)
    assert not capture._thread.is_alive()


@pytest.mark.parametrize("name", ["missing/capture.pcapng", "."])
def test_a_path_that_cannot_be_opened_is_refused_at_once(tmp_path: Path, name: str) -> None:
    with pytest.raises(CallerError, match="the capture cannot be opened: "):
        CaptureWriter(tmp_path / name, SPECS)


def test_a_terminal_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
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
