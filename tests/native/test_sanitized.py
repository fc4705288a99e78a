"""The core does nothing that is undefined in C: it runs with ASan and UBSan, in a child process."""

import subprocess

import pytest

from tests.native import sanitized_core

ROOT = sanitized_core.ROOT
PYTEST = ("pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-s")


def run_tests(*arguments: str) -> None:
    """Run tests in a process that has the core with sanitizers; skip if there can be none."""
    try:
        command, environment = sanitized_core.command(*PYTEST, *arguments)
    except sanitized_core.NoSanitizersError as error:
        pytest.skip(str(error))
    done = subprocess.run(
        command, env=environment, cwd=ROOT, capture_output=True, text=True, check=False, timeout=500
    )
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[:4000]


def test_random_links_run_clean() -> None:
    run_tests("tests/native/links_under_sanitizers.py")


def test_links_of_any_numbers_are_refused_or_run_clean() -> None:
    run_tests("tests/fuzz/test_parsers.py", "-k", "link_numbers")


def test_any_datagrams_are_read_clean() -> None:
    run_tests(
        "tests/fuzz/test_parsers.py", "tests/noack/protocol/test_wire_format.py", "-k", "wire"
    )


def test_the_live_driver_runs_clean() -> None:
    run_tests("tests/noack/runtime/test_live_driver.py", "tests/noack/runtime/test_peer_sockets.py")
