"""Worker processes of this machine."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing.connection import Connection

_KEPT_BYTES = str(32 * 2**20)
_ENVIRONMENT = dict.fromkeys(
    ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
) | {
    "PYTHONSAFEPATH": "1",
    "MALLOC_MMAP_THRESHOLD_": _KEPT_BYTES,
    "MALLOC_TRIM_THRESHOLD_": _KEPT_BYTES,
}  # fmt: skip
"""One thread each, and no imports from the current folder (:mod:`noack.core.process_limits`). They
keep freed memory: with new memory for each part of a record, half of the time is page faults."""

_ENDING = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}


@contextmanager
def processes(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Start processes of one thread each; submit to them within :func:`interrupts_held`.

    They end with the parent, however it ends.
    """
    # A fork would inherit threads of the libraries.
    context = multiprocessing.get_context("spawn")
    theirs, ours = context.Pipe(duplex=False)
    before = {name: os.environ.get(name) for name in _ENVIRONMENT}
    os.environ.update(_ENVIRONMENT)  # inherited by the children
    with interrupts_held():  # it starts a process for semaphores
        pool = ProcessPoolExecutor(workers, context, _depend_on, (theirs,))
    try:
        yield pool
        pool.shutdown()
    finally:
        ours.close()  # ends processes that still compute
        pool.shutdown(cancel_futures=True)
        theirs.close()
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _depend_on(parent: Connection) -> None:
    """End this process when the parent closes its end of the pipe."""

    def follow() -> None:
        parent.poll(None)
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Block the signals that end a program in processes that are started meanwhile.

    The parent handles them.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _ENDING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
