"""Worker processes of this machine."""

import gc
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from types import ModuleType
from typing import TypeVar

from netem.core.command_line import END_SIGNALS

_KEPT_BYTES = str(32 * 2**20)
_ENVIRONMENT = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1") | {
    "PYTHONSAFEPATH": "1",
    "MALLOC_MMAP_THRESHOLD_": _KEPT_BYTES,
    "MALLOC_TRIM_THRESHOLD_": _KEPT_BYTES,
}
"""One thread each, and no imports from the current folder (:mod:`netem.core.system_processes`). They
keep freed memory: with new memory for each part of a record, half of the time is page faults."""

_STARTS = threading.Lock()
ENDINGS = {getattr(signal, name) for name in END_SIGNALS}
"""Numbers of the signals that end a program."""
Item = TypeVar("Item")
Result = TypeVar("Result")


@contextmanager
def processes(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Start processes of one thread each; submit to them within :func:`process_starts`.

    They end with the parent, however it ends.
    """
    # A fork would inherit threads of the libraries.
    context = multiprocessing.get_context("spawn")
    child_end, own_end = context.Pipe(duplex=False)
    with environment(_ENVIRONMENT):
        with process_starts():  # it starts a process for semaphores
            pool = ProcessPoolExecutor(workers, context, _depend_on, (child_end, gc.get_threshold()))
        try:
            yield pool
            pool.shutdown()
        finally:
            own_end.close()  # ends processes that still compute
            pool.shutdown(cancel_futures=True)
            child_end.close()


def start_alone(function: Callable[..., object], *arguments: object) -> BaseProcess:
    """Start a process of one thread that calls a function; it ends with this one, however this one ends."""
    with environment(_ENVIRONMENT), process_starts():
        process = multiprocessing.get_context("spawn").Process(target=_call, args=(function, *arguments))
        process.daemon = True
        process.start()
    return process


def _call(function: Callable[..., object], *arguments: object) -> None:
    _end_when(multiprocessing.parent_process().join)  # type: ignore[union-attr]
    function(*arguments)


@contextmanager
def environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables within this context, for the processes that are started in it."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def map_in(
    pool: ProcessPoolExecutor | None, function: Callable[[Item], Result], items: Sequence[Item]
) -> Iterable[Result]:
    """Yield ``function(item)`` of each item in order, computed by processes; without them, here.

    The processes begin at once. What a killed process leaves over is computed here.
    """
    if pool is None:
        return map(function, items)
    futures: list[Future[Result] | None] = []
    with process_starts():
        for item in items:
            try:
                futures.append(pool.submit(function, item))
            except BrokenProcessPool:
                futures.append(None)
    return (_result(future, function, item) for future, item in zip(futures, items, strict=True))


def _result(future: Future[Result] | None, function: Callable[[Item], Result], item: Item) -> Result:
    try:
        return function(item) if future is None else future.result()
    except BrokenProcessPool:
        return function(item)


def _depend_on(parent: Connection, threshold: tuple[int, int, int]) -> None:
    """End this process when the parent closes its end of the pipe; collect garbage as it does."""
    gc.set_threshold(*threshold)
    _end_when(lambda: parent.poll(None))


def _end_when(wait: Callable[[], object]) -> None:
    """End this process when a function returns."""

    def follow() -> None:
        wait()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


@contextmanager
def process_starts() -> Iterator[None]:
    """Start processes within this context.

    In them, the signals that end a program are blocked: the parent handles them. They do not
    import the parent's main module, as multiprocessing lets them do: a user's program need not
    have an ``if __name__ == "__main__"``.
    """
    with _STARTS, _block_endings():
        main, sys.modules["__main__"] = sys.modules["__main__"], ModuleType("__main__")
        try:
            yield
        finally:
            sys.modules["__main__"] = main


@contextmanager
def _block_endings() -> Iterator[None]:
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDINGS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
