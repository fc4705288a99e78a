"""Programs that benchmarks start: noack as a user starts it, C programs; on one core."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, suppress
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

from benchmarks.report import MeasurementError
from tests.helpers.live_runs import EPHEMERAL, noack_command

_Result = TypeVar("_Result")
PRIORITY = 50
"""SCHED_FIFO priority of a run's processes, by default."""


def program_path(name: str, package: str) -> str:
    """Return the path of a program that a package of Debian has."""
    if (path := shutil.which(name)) is None:
        raise MeasurementError(f"{name} is not installed (Debian: apt-get install {package})")
    return path


@cache
def _compiled_programs() -> "tempfile.TemporaryDirectory[str]":
    return tempfile.TemporaryDirectory(prefix="noack-bench-")


@cache
def compile_program(source: str, *options: str) -> str:
    """Compile a C file of this folder; return the path of the program, which exists until the end."""
    target = str(Path(_compiled_programs().name) / Path(source).stem)
    path = str(Path(__file__).with_name(source))
    execute(program_path("cc", "gcc"), "-O2", *options, "-o", target, path)
    return target


def execute(*command: str) -> str:
    """Run a program to its end; return what it printed."""
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        last = (done.stderr.strip() or done.stdout.strip() or "no message").splitlines()[-1]
        raise MeasurementError(f"{command[0]} ended with {done.returncode}: {last}")
    return done.stdout


def imported_s(modules: str) -> float:
    """Return wall seconds from the start of a Python to the end of its imports."""
    began_s = time.monotonic()
    execute(sys.executable, "-c", f"import {modules}, os; os._exit(0)")
    return time.monotonic() - began_s


def in_new_process(call: Callable[..., _Result], *arguments: object) -> _Result:
    """Return what a call returns in a process of its own."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(call, *arguments).result()


def set_options(*settings: str) -> list[str]:
    """Return the options of a command that change settings of a scenario."""
    return [word for setting in settings for word in ("--set", setting)]


def noack(*arguments: str) -> dict[str, Any]:
    """Run ``noack ARGUMENTS`` to its end; return the summary of its run."""
    with tempfile.TemporaryDirectory(prefix="noack-bench-") as runs:
        command = noack_command(*arguments, *EPHEMERAL, "--runs", runs, "--json")
        summary: dict[str, Any] = json.loads(execute(*command))
    return summary


_CORES = sorted(os.sched_getaffinity(0))
RELAY_CORE, LOAD_CORE = _CORES[0], _CORES[-1]
"""Where relays run, and where their load does."""


@contextmanager
def on_core(core: int, priority: int = 1) -> Iterator[bool]:
    """Pin the calling thread to a core, with SCHED_FIFO if permitted.

    With the lowest priority other programs of the machine do not affect a comparison of relays. End
    no process in it: the kernel may then wait for one of lower priority on this core, for ever.

    Yields:
        Whether SCHED_FIFO was permitted.
    """
    cores, policy, parameters = os.sched_getaffinity(0), os.sched_getscheduler(0), os.sched_getparam(0)
    os.sched_setaffinity(0, {core})
    try:
        with suppress(PermissionError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        yield os.sched_getscheduler(0) == os.SCHED_FIFO
    finally:
        os.sched_setscheduler(0, policy, parameters)
        os.sched_setaffinity(0, cores)
