"""Fixtures for netem's tests: many compiled decisions, and emulators in separate processes."""

import json
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow.parquet as pq
import pytest
from numpy.typing import ArrayLike, NDArray

from netem.link_state import LinkState
from netem.tc_words import settings_of
from noack.impairments.link_settings import Decisions, LinkSettings

MOST = 1_000_000


class Decided(NamedTuple):
    """The decisions for k datagrams, arrays of shape (k,), and the link."""

    decisions: NDArray[Any]
    flows: NDArray[np.int64]
    arrivals_ns: NDArray[np.int64]
    link: LinkState

    @property
    def fates(self) -> NDArray[np.int64]:
        return np.asarray(self.decisions["fate"])

    @property
    def delays_ns(self) -> NDArray[np.int64]:
        """Times from arrival to departure in ns, without lost datagrams."""
        times_ns = self.decisions["release_ns"]
        return np.asarray((times_ns - self.arrivals_ns)[times_ns >= 0])


Decide = Callable[..., Decided]


@pytest.fixture(scope="session")
def decide() -> Decide:
    """Return many decisions; a scalar argument applies to all datagrams."""

    def run(
        settings: LinkSettings | str,
        count: int,
        *,
        seed: int = 0,
        flows: ArrayLike = 0,
        sizes_bytes: ArrayLike = 100,
        arrivals_ns: ArrayLike | None = None,
        recorded: Decisions = (),
        name: Sequence[str] = ("test",),
    ) -> Decided:
        if isinstance(settings, str):
            settings = settings_of(settings).model_copy(update={"limit": MOST})
        all_flows = np.array(np.broadcast_to(np.asarray(flows, np.int64), count))
        if arrivals_ns is None:
            arrivals_ns = np.arange(count) * 1_000
        arrivals = np.array(np.broadcast_to(np.asarray(arrivals_ns, np.int64), count))
        sizes = np.array(np.broadcast_to(np.asarray(sizes_bytes, np.int64), count))
        link = LinkState(settings, seed, *name, decisions=recorded)
        for flow in range(int(all_flows.max(initial=0)) + 1):
            link.start_flow(flow, flow)
        return Decided(link.decide_many(all_flows, sizes, arrivals), all_flows, arrivals, link)

    return run


def _assert_share(flags: ArrayLike, expected: float, batches: int = 200) -> None:
    """Check that the mean agrees with ``expected`` to five standard errors of the batch means.

    Flags may be correlated, but the correlation over a whole batch is negligible. The seeds are
    fixed; with random seeds, one test in a million would fail.
    """
    values = np.asarray(flags, float)
    means = values[: len(values) // batches * batches].reshape(batches, -1).mean(axis=1)
    error = means.std(ddof=1) / np.sqrt(batches)
    assert abs(means.mean() - expected) <= 5 * error
    assert error <= 0.1 * expected  # else the assertion above is too weak


@pytest.fixture(scope="session")
def share_is() -> Callable[..., None]:
    return _assert_share


class Emulator:
    """``python -m netem`` with one link, in a separate folder.

    Args:
        folder: the folder for its fate trace.
        to: the server, HOST:PORT.
        words: impairments and options.
        listen: the address to which clients send.
        inside: a command prefix, e.g. to run the emulator in a network namespace.
    """

    def __init__(self, folder: Path, to: str, *words: str, listen: str, inside: Sequence[str] = ()) -> None:
        self._trace = folder / "fates.parquet"
        self.process = subprocess.Popen(
            [
                *inside, sys.executable, "-m", "netem", "--listen", listen, "--to", to, "--json",
                "--record-fates", str(self._trace), *words,
            ],
            cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert self.process.stdout is not None
        ready = self.process.stdout.readline()
        assert ready, self.process.communicate()[1]
        (link,) = json.loads(ready)["ready"]
        self.host, _, port = link["listen"].rpartition(":")
        self.port = int(port)

    def finish(self) -> dict[str, Any]:
        """End the emulator and check for unintended losses; return its link's statistics."""
        link, status, stderr = self.end()
        assert status == 0, stderr
        for line in stderr.splitlines():
            # A program may end with datagrams to it in flight.
            usual = ("Ctrl-C ends", "ICMP port unreachable")
            assert any(words in line for words in usual), stderr
        return link

    def end(self) -> tuple[dict[str, Any], int, str]:
        """End the emulator; return its link's statistics, exit status and standard error."""
        self.process.send_signal(signal.SIGINT)
        stdout, stderr = self.process.communicate(timeout=60)
        (link,) = json.loads(stdout)["links"]
        return dict(link), self.process.returncode, stderr

    def fates(self, direction: str) -> list[dict[str, Any]]:
        """Return the fate of each datagram of the first flow, in the order of arrival."""
        rows: list[dict[str, Any]] = pq.read_table(self._trace).to_pylist()
        return [row for row in rows if row["direction"] == direction and row["flow"] == 0]


Emulate = Callable[..., Emulator]


@pytest.fixture
def emulate(tmp_path: Path) -> Iterator[Emulate]:
    """Start emulators; kill the remaining ones at the end."""
    started: list[Emulator] = []

    def start(to: str, *words: str, listen: str = "127.0.0.1:0", inside: Sequence[str] = ()) -> Emulator:
        folder = tmp_path / f"emulator {len(started)}"
        folder.mkdir()
        started.append(Emulator(folder, to, *words, listen=listen, inside=inside))
        return started[-1]

    yield start
    for emulator in started:
        emulator.process.kill()
        emulator.process.communicate()
