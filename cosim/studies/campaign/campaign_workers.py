"""Computes the chunks of a campaign: in processes of this machine or on a Dask cluster.

Chunks are independent of each other. Only this process writes results. Workers must have the same
code, libraries and arithmetic (``arithmetic.py``).
"""

import logging
import math
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from itertools import islice
from typing import Any, NamedTuple, Protocol
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray

from cosim.live.processes.process_pool import process_starts, processes
from cosim.studies.campaign.arithmetic import arithmetic, difference
from netem.core.errors import CallerError, PeerError
from netem.core.number_checks import whole_number
from netem.core.system_processes import cores


class Work(Protocol):
    """Computes the draws of a grid point; sent to another process with each chunk."""

    def run(self, draws: range) -> NDArray[np.void]:
        """Compute consecutive draws; one row each."""
        ...


class Chunk(NamedTuple):
    """Consecutive draws at a grid point."""

    point: int
    start: int
    stop: int

    @property
    def draws(self) -> range:
        """Numbers of the draws."""
        return range(self.start, self.stop)


_PER_CORE = 4
"""Most worker processes per core; more gain nothing, and use memory."""


def worker_count(workers: int | None) -> int:
    """Return the number of worker processes, by default one per core; raise CallerError if it is wrong."""
    return cores() if workers is None else whole_number("workers", workers, 1, _PER_CORE * cores())


FinishedChunk = tuple[Chunk, NDArray[np.void]]
Runner = Callable[[Sequence[Work], Iterable[Chunk]], Iterator[FinishedChunk]]
"""Computes chunks, given the work of each grid point; yields results in any order."""

_CHUNKS_AHEAD = 2
"""Chunks in flight per worker: one is computed and one waits."""
_LOOK_EVERY_S, _PATIENCE_S = 1.0, 30.0
"""Time between two looks at the cluster, and time that it may be without a worker."""
_CONNECT_S, _CONNECT_TRIES = 10.0, 3


class OtherArithmeticError(PeerError):
    """A worker's arithmetic differs: it would compute other results."""


class LostWorkersError(PeerError):
    """Workers have died or cannot be reached."""


def run_in_process(works: Sequence[Work], chunks: Iterable[Chunk]) -> Iterator[FinishedChunk]:
    """Compute chunks in this process."""
    for chunk in chunks:
        yield chunk, works[chunk.point].run(chunk.draws)


@contextmanager
def local_runner(workers: int) -> Iterator[Runner]:
    """Compute chunks in processes of this machine."""
    if workers == 1:
        yield run_in_process
        return
    with processes(workers) as pool:

        def run(works: Sequence[Work], chunks: Iterable[Chunk]) -> Iterator[FinishedChunk]:
            try:
                yield from _limit_in_flight(pool, works, chunks, lambda: _CHUNKS_AHEAD * workers)
            except BrokenProcessPool:
                raise LostWorkersError("a worker process was killed (out of memory?)") from None

        yield run


def _require_address(address: str) -> None:
    """Check an address first: Dask's client takes long to report a wrong one."""
    try:
        parts = urlsplit(address if "://" in address else f"tcp://{address}")
        is_complete = parts.scheme in ("tcp", "tls") and parts.hostname and parts.port
    except ValueError:
        is_complete = False
    if not is_complete:
        raise CallerError(f"--scheduler {address}: write it as tcp://HOST:PORT")


def _client(connect: Any, address: str) -> Any:
    """Connect, with retries: on a busy machine Dask's thread may not start within ten seconds."""
    for _ in range(_CONNECT_TRIES):
        with suppress(AssertionError):
            return connect(address, timeout=_CONNECT_S, set_as_default=False)
    raise PeerError(f"--scheduler {address}: Dask's client does not start; the machine is too busy")


def run_alike(work: Work, draws: range, expected: Mapping[str, str] | None) -> NDArray[np.void]:
    """Compute consecutive draws in another process, or on another machine.

    Raises:
        OtherArithmeticError: its results would differ from those of the caller.
    """
    if expected is not None and (cause := difference(arithmetic(), expected)) is not None:
        raise OtherArithmeticError(f"a worker on {socket.gethostname()} would compute other results: {cause}")
    return work.run(draws)


@contextmanager
def cluster_runner(address: str, report: Callable[[str], None] = lambda line: None) -> Iterator[Runner]:
    """Compute chunks on the Dask cluster of this scheduler; workers need the same noack.

    ``report`` is called with a message when the campaign waits for the cluster.

    Raises:
        CallerError: Dask is not installed, or the address is not valid.
        PeerError: the scheduler does not answer.
    """
    try:
        import distributed  # an extra
    except ImportError:
        raise CallerError(
            "--scheduler needs Dask, which is not installed; pip install 'noack[cluster]'"
        ) from None
    _require_address(address)
    for name in list(logging.root.manager.loggerDict):
        if name.startswith("distributed"):  # Dask's errors are reported below
            logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        client = _client(distributed.Client, address)
    except (OSError, TimeoutError):
        raise PeerError(f"--scheduler {address}: no Dask scheduler answers there") from None

    def run(works: Sequence[Work], chunks: Iterable[Chunk]) -> Iterator[FinishedChunk]:
        size = _ClusterSize(client, address, report)
        executor: Executor = client.get_executor(pure=False)
        try:
            yield from _limit_in_flight(executor, works, chunks, size, arithmetic())
        except OtherArithmeticError as error:
            raise OtherArithmeticError(f"{address}: {error}") from None
        except (ImportError, RuntimeError) as error:
            if isinstance(error, RuntimeError) and "deserializ" not in str(error):
                raise
            raise PeerError(
                f"{address}: scheduler and workers need the same noack and its libraries"
            ) from None
        except CancelledError:
            raise LostWorkersError(f"{address}: the scheduler has ended") from None
        except distributed.scheduler.KilledWorker:
            raise LostWorkersError(
                f"{address}: several workers died with the same chunk (out of memory?)"
            ) from None

    with client:
        yield run


class _ClusterSize:
    """The number of chunks that may be in flight on a cluster with a varying number of workers."""

    def __init__(self, client: Any, address: str, report: Callable[[str], None]) -> None:
        self._client, self._address, self._report = client, address, report
        self._reported = False
        self._cores, self._looked_s, self._seen_s = 0, -math.inf, time.monotonic()

    def __call__(self) -> int:
        """Return the number of chunks; queries the cluster at most once per second.

        Raises:
            LostWorkersError: the scheduler has ended, or there has been no worker for 30 s.
        """
        now_s = time.monotonic()
        if now_s - self._looked_s > _LOOK_EVERY_S:
            try:
                self._cores = sum(self._client.ncores().values())
            except (OSError, TimeoutError):
                raise LostWorkersError(f"{self._address}: the scheduler has ended") from None
            self._looked_s = now_s
            if self._cores:
                self._seen_s, self._reported = now_s, False
            elif not self._reported:
                self._reported = True
                self._report(f"{self._address}: no worker; waiting {_PATIENCE_S:g} s for one")
            elif now_s - self._seen_s > _PATIENCE_S:
                raise LostWorkersError(
                    f"{self._address}: the cluster has had no worker for {_PATIENCE_S:g} s "
                    "(workers with an older noack end at once)"
                )
        return max(_CHUNKS_AHEAD * self._cores, 1)


def _limit_in_flight(
    executor: Executor,
    works: Sequence[Work],
    chunks: Iterable[Chunk],
    most_chunks: Callable[[], int],
    expected: Mapping[str, str] | None = None,
) -> Iterator[FinishedChunk]:
    """Keep a limited number of chunks in flight, so that memory use stays bounded."""
    waiting = iter(chunks)
    in_flight: dict[Future[NDArray[np.void]], Chunk] = {}
    while True:
        for chunk in islice(waiting, max(most_chunks() - len(in_flight), 0)):
            with process_starts():
                future = executor.submit(run_alike, works[chunk.point], chunk.draws, expected)
            in_flight[future] = chunk
        if not in_flight:
            return
        finished, _ = wait(in_flight, _LOOK_EVERY_S, FIRST_COMPLETED)
        for future in finished:
            yield in_flight.pop(future), future.result()
