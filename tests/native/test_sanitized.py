"""The core does nothing that is undefined in C: it runs with ASan and UBSan, in a child process."""

import subprocess
from collections.abc import Sequence

import pytest

from tests.native import sanitized_core

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


@pytest.mark.parametrize("arguments", [
    ("tests/native/machines_under_sanitizers.py",),
    ("tests/fuzz/test_parsers.py", "tests/netem/capture/test_pcapng.py",
     "tests/noack/protocol/test_wire_format.py", "-k", "link_numbers or pcapng or wire"),
    ("tests/netem/test_link.py", "tests/netem/test_mansd.py",
     "tests/cosim/simulation/test_event_order.py", "tests/cosim/simulation/test_several_loops.py",
     "tests/cosim/analysis/test_replay.py", "tests/cosim/analysis/adversary/test_worst_patterns.py",
     "-k", "plain_network or no_network or in_time or restarted or several_loops or "
     "(event_order and not random) or (test_replay and (numbers or exact or bit_for_bit or "
     "runs_end)) or (test_worst_patterns and (machines or early))"),
    ("tests/noack/runtime/test_live_driver.py", "tests/noack/runtime/test_peer_sockets.py"),
    ("tests/cosim/output/export/test_fmu_export.py", "-k",
     "not plain and not slow and not command"),
], ids=["random machines and exact simulations", "parsers", "simulations and replays",
        "the live driver", "FMUs"])  # fmt: skip
def test_these_tests_run_clean(arguments: Sequence[str]) -> None:
    done = run(*PYTEST, *arguments)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[:4000]
