"""Processes of this machine that compute for one parent."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing.connection import Connection

_ENVIRONMENT = dict.fromkeys(
    ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
) | {"PYTHONSAFEPATH": "1"}
"""One thread each; and none imports from the current folder (:mod:`noack.core.python_process`), as
Python would before multiprocessing hands it the parent's path."""


@contextmanager
def processes(workers: int) -> Iterator[ProcessPoolExecutor]:
    """So many processes, each on one thread; submit to them with :func:`interrupts_held`.

    None outlives the parent, however it ends.
    """
    # A fork would inherit whatever threads the libraries have started.
    context = multiprocessing.get_context("spawn")
    theirs, ours = context.Pipe(duplex=False)
    before = {name: os.environ.get(name) for name in _ENVIRONMENT}
    os.environ.update(_ENVIRONMENT)  # for the children, who inherit it
    with interrupts_held():  # it starts a process that keeps account of semaphores
        pool = ProcessPoolExecutor(workers, context, _depend_on, (theirs,))
    try:
        yield pool
        pool.shutdown()
    finally:
        ours.close()  # ends those that are still at work
        pool.shutdown(cancel_futures=True)
        theirs.close()
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _depend_on(parent: Connection) -> None:
    """No worker outlives the parent's end of the pipe."""

    def follow() -> None:
        parent.poll(None)
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Hold Ctrl-C and a closed terminal back: what is started meanwhile never hears of them.

    The parent decides what they mean.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
