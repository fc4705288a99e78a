"""The core does nothing that is undefined in C: it runs with ASan and UBSan, in a child process."""

import re
import subprocess

import pytest

from tests.native import sanitized_core
from tests.native.out_of_bounds import ENDS

ROOT = sanitized_core.ROOT
PYTEST = ("pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-s")


def run(*module: str) -> subprocess.CompletedProcess[str]:
    """Run a module in a process that has the core with sanitizers; skip if there can be none."""
    try:
        command, environment = sanitized_core.command(*module)
    except sanitized_core.NoSanitizersError as error:
        pytest.skip(str(error))
    return subprocess.run(
        command, env=environment, cwd=ROOT, capture_output=True, text=True, check=False, timeout=500
    )


def run_tests(*arguments: str) -> None:
    """Run tests in such a process."""
    done = run(*PYTEST, *arguments)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[:4000]


def test_the_end_of_each_array_is_known() -> None:
    done = run("tests.native.out_of_bounds")
    assert done.stderr.count("ERROR: AddressSanitizer: heap-buffer-overflow") == len(ENDS)
    places = re.findall(r"located (\d+) bytes (?:to the right of|after)", done.stderr)
    assert places == ["0"] * len(ENDS)
    assert (done.returncode, done.stdout) == (0, "")


def test_random_machines_run_clean() -> None:
    run_tests("tests/native/machines_under_sanitizers.py")


def test_random_links_run_clean() -> None:
    run_tests("tests/native/links_under_sanitizers.py")


def test_random_exact_simulations_run_clean() -> None:
    run_tests("tests/native/exact_under_sanitizers.py")


def test_links_of_any_numbers_are_refused_or_run_clean() -> None:
    run_tests("tests/fuzz/test_parsers.py", "-k", "link_numbers")


def test_captures_of_any_events_are_refused_or_run_clean() -> None:
    run_tests("tests/netem/capture/test_pcapng.py")


def test_any_datagrams_are_read_clean() -> None:
    run_tests(
        "tests/fuzz/test_parsers.py", "tests/noack/protocol/test_wire_format.py", "-k", "wire"
    )


def test_simulations_and_replays_run_clean() -> None:
    run_tests("tests/netem/test_channel.py", "tests/cosim/simulation/test_event_order.py")
    run_tests(
        "tests/cosim/analysis/test_replay.py", "-k", "numbers or exact or bit_for_bit or runs_end"
    )
    run_tests("tests/cosim/analysis/adversary/test_worst_patterns.py", "-k", "machines or early")


def test_the_live_driver_runs_clean() -> None:
    run_tests("tests/noack/runtime/test_live_driver.py", "tests/noack/runtime/test_peer_sockets.py")
