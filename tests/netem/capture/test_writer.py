import errno
import os
import resource
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from queue import SimpleQueue

import numpy as np
import pytest

from netem.capture.capture_writer import CaptureWriter
from netem.capture.packet_blocks import Bytes, Events
from netem.capture.pcapng import PcapngSection
from noack.core.errors import CallerError
from tests.netem.capture.batches import INTERFACES, batch, file_of
from tests.netem.capture.reader import read

FOUR = [{"packet": number, "interface": number % 2} for number in range(4)]
PATIENCE_S = 60.0


@pytest.fixture
def fifo(tmp_path: Path) -> Path:
    path = tmp_path / "fifo"
    os.mkfifo(path)
    return path


@pytest.fixture
def reader(fifo: Path) -> Iterator[int]:
    """An open reader of the FIFO that reads nothing by itself."""
    descriptor = os.open(fifo, os.O_RDONLY | os.O_NONBLOCK)
    os.set_blocking(descriptor, True)
    yield descriptor
    os.close(descriptor)


def drain(descriptor: int) -> bytes:
    chunks = []
    while chunk := os.read(descriptor, 1 << 16):
        chunks.append(chunk)
    return b"".join(chunks)


def test_the_file_holds_what_was_offered(tmp_path: Path) -> None:
    path = tmp_path / "capture.pcapng"
    path.write_bytes(b"an older capture" * 1000)
    with CaptureWriter(path, INTERFACES) as capture:
        for event in FOUR:
            assert capture.offer(*batch(event))
    assert path.read_bytes() == file_of(*FOUR)
    assert (capture.error, capture.missing, capture.written) == (None, 0, 4)
    assert not capture.offer(*batch({}))
    assert capture.missing == 1


def test_arrays_come_back_when_they_are_written(tmp_path: Path) -> None:
    returned: SimpleQueue[tuple[Events, Bytes]] = SimpleQueue()
    offered = [batch(event) for event in FOUR]
    with CaptureWriter(
        tmp_path / "capture.pcapng", INTERFACES, returned=lambda *arrays: returned.put(arrays)
    ) as capture:
        for events, data in offered:
            capture.offer(events, data)
            back = returned.get(timeout=PATIENCE_S)
            assert back[0] is events
            assert back[1] is data
        # All is in the file already: nothing waits for a full buffer.
        on_disk = read((tmp_path / "capture.pcapng").read_bytes())
        assert len(on_disk.packets) == 4
        assert on_disk.statistics == {}


def test_what_does_not_fit_the_queue_is_missing_and_the_file_says_so(tmp_path: Path) -> None:
    path = tmp_path / "capture.pcapng"
    taken: SimpleQueue[None] = SimpleQueue()
    go_on = threading.Event()

    def returned(*_: object) -> None:
        taken.put(None)
        assert go_on.wait(PATIENCE_S)

    with CaptureWriter(path, INTERFACES, batches=2, returned=returned) as capture:
        assert capture.offer(*batch({}))
        taken.get(timeout=PATIENCE_S)  # and now the writer does not look at the queue
        assert capture.offer(*batch({}))
        assert capture.offer(*batch({}))
        assert capture.missing == 0
        assert not capture.offer(*batch({}, {}))
        assert not capture.offer(*batch({"interface": 1}))
        capture.miss(np.array([0, 10]))
        assert capture.missing == 13
        go_on.set()
        for _ in range(2):
            taken.get(timeout=PATIENCE_S)
        assert capture.offer(*batch({"interface": 1}, {"interface": 1}, {}))
        taken.get(timeout=PATIENCE_S)
        capture.miss(np.array([100, 0]))
    assert (capture.missing, capture.written, capture.error) == (113, 6, None)
    file = read(path.read_bytes())
    told = [packet.options.get(4, [b""])[0] for packet in file.packets]
    assert [int.from_bytes(count, "little") for count in told] == [0, 0, 0, 11, 0, 2]
    received_and_dropped = [
        [int.from_bytes(options[code][0], "little") for code in (4, 5)]
        for _, options in file.statistics.values()
    ]
    assert received_and_dropped == [[4 + 102, 102], [2 + 11, 11]]


def test_a_full_disk_ends_the_capture_in_one_line_and_nothing_else(tmp_path: Path) -> None:
    with CaptureWriter("/dev/full", INTERFACES) as capture:
        capture.offer(*batch(*FOUR))
        capture.close()
        assert not capture.offer(*batch(*FOUR))
    assert capture.error == (
        f"/dev/full: the capture ends after 0 events: {os.strerror(errno.ENOSPC)}"
    )
    assert (capture.missing, capture.written) == (8, 0)


def test_a_capture_that_a_full_disk_ends_can_be_read(tmp_path: Path) -> None:
    path = tmp_path / "capture.pcapng"
    payload = {"payload": bytes(60_000)}
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, limits[1]))
    try:
        with CaptureWriter(path, INTERFACES) as capture:
            for _ in range(40):
                capture.offer(*batch(payload))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert capture.error is not None
    assert capture.error.endswith(f"ends after 17 events: {os.strerror(errno.EFBIG)}")
    assert (capture.written, capture.missing) == (17, 23)
    assert len(read(path.read_bytes()).packets) == 17


def test_an_impossible_event_ends_the_capture_not_the_packet_path(tmp_path: Path) -> None:
    with CaptureWriter(tmp_path / "capture.pcapng", INTERFACES) as capture:
        capture.offer(*batch({}))
        capture.offer(*batch({"family": 5}))
    assert capture.error is not None
    assert "after 1 events: event 0 of a batch is impossible" in capture.error
    assert len(read((tmp_path / "capture.pcapng").read_bytes()).packets) == 1


def test_a_reader_that_goes_away_ends_the_capture(fifo: Path) -> None:
    descriptor = os.open(fifo, os.O_RDONLY | os.O_NONBLOCK)
    capture = CaptureWriter(fifo, INTERFACES)
    os.close(descriptor)
    capture.close()
    assert capture.error is not None
    assert capture.error.endswith(os.strerror(errno.EPIPE))


def test_a_reader_that_reads_nothing_does_not_keep_the_process(fifo: Path, reader: int) -> None:
    capture = CaptureWriter(fifo, INTERFACES)
    for _ in range(3):
        capture.offer(*batch({"payload": bytes(60_000)}))
    capture.close(patience_s=0.05)
    assert capture.error is not None
    assert capture.error.endswith(": it has taken nothing for 0.05 s")
    assert capture.missing == 3 - capture.written > 0
    drain(reader)
    capture._thread.join(PATIENCE_S)
    assert not capture._thread.is_alive()


@pytest.mark.parametrize("name", ["missing/capture.pcapng", "."])
def test_a_path_that_cannot_be_opened_is_refused_at_once(tmp_path: Path, name: str) -> None:
    with pytest.raises(CallerError, match="the capture cannot be opened: "):
        CaptureWriter(tmp_path / name, INTERFACES)


def test_a_terminal_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "isatty", lambda descriptor: descriptor == 1)
    with pytest.raises(CallerError, match="not for a terminal"):
        CaptureWriter("-", INTERFACES)


def test_the_standard_output_takes_a_capture() -> None:
    program = (
        "from netem.capture.capture_writer import CaptureWriter\n"
        "from tests.netem.capture.batches import *\n"
        "with CaptureWriter('-', INTERFACES) as capture: capture.offer(*batch({}, {'flow': 5}))\n"
        "assert capture.error is None\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, check=True, timeout=PATIENCE_S
    )
    assert done.stdout == file_of({}, {"flow": 5})


def test_the_section_is_made_before_the_file_is_touched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A failing compilation leaves an older capture alone."""

    def fail(*_: object) -> None:
        raise RuntimeError

    path = tmp_path / "capture.pcapng"
    path.write_bytes(b"older")
    monkeypatch.setattr(PcapngSection, "packets", fail)
    with pytest.raises(RuntimeError):
        CaptureWriter(path, INTERFACES)
    assert path.read_bytes() == b"older"
