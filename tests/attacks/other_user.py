"""Run a program as another user of this machine; this needs root."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

NOBODY = 65534


def needs_root(test: Callable[..., None]) -> Callable[..., None]:
    """Mark a test that acts as another user."""
    return pytest.mark.system(
        pytest.mark.skipif(os.getuid() != 0, reason="acts as another user: takes root")(test)
    )


_BECOME = """
import encodings.idna, http.server, os, sys, urllib.error, urllib.request
os.setgroups([]); os.setgid({user}); os.setuid({user})
"""  # imported first: the other user may not have access to Python's folder


@contextmanager
def as_another_user(code: str, *arguments: str) -> Iterator["subprocess.Popen[str]"]:
    """Run a program as another user while the context lasts; its output can be read."""
    with subprocess.Popen(
        [sys.executable, "-c", _BECOME.format(user=NOBODY) + code, *arguments],
        stdout=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        try:
            yield process
        finally:
            process.kill()


def output_of_another_user(code: str, *arguments: str) -> str:
    """Run a program as another user to its end, and return what it printed."""
    with as_another_user(code, *arguments) as process:
        return process.communicate(timeout=60)[0].strip()
