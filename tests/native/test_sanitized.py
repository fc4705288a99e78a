"""The core does nothing that is undefined in C: it runs with ASan and UBSan, in a child process."""

import re
import subprocess

import pytest

from tests.native import sanitized_core

pytestmark = pytest.mark.builds
ROOT = sanitized_core.ROOT
PYTEST = ("pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-s", "--hypothesis-profile=few")


def run(*module: str) -> subprocess.CompletedProcess[str]:
    """Run a module in a process that has the core with sanitizers; skip if there can be none."""
    try:
        command, environment = sanitized_core.command(*module)
    except sanitized_core.NoSanitizersError as error:
        pytest.skip(str(error))
    return subprocess.run(
        command, env=environment, cwd=ROOT, capture_output=True, text=True, check=False, timeout=500
    )


FILES = (
    "tests/native/machines_under_sanitizers.py", "tests/fuzz/test_parsers.py",
    "tests/netem/capture/test_pcapng.py", "tests/noack/protocol/test_wire_format.py",
    "tests/netem/test_link_state.py", "tests/netem/test_channel.py", "tests/noack/impairments/test_mansd.py",
    "tests/cosim/simulation/test_virtual_time.py",
    "tests/cosim/simulation/test_several_loops.py", "tests/cosim/analysis/replay/test_run_replay.py",
    "tests/cosim/analysis/adversary/test_worst_patterns.py", "tests/noack/runtime/test_live_driver.py",
    "tests/noack/runtime/test_udp_sockets.py", "tests/cosim/output/export/test_fmu_export.py",
)  # fmt: skip
NAMES = (
    "machines_under_sanitizers", "link_numbers", "wire", "pcapng", "plain_network", "no_network", "in_time",
    "restarted_link", "scripted_network", "different_sizes", "no_simulation", "delay1-ack",
    "queue_overflows", "changed_bit", "report_their_errors", "replayed_bit_for_bit", "runs_end",
    "restarted_controller", "record_with_any_numbers", "[slow ", "[fast ", "disturbed]", "observed]",
    "too_early", "one_by_one", "sent_together", "answered[1-True]", "answered[70-True]", "1000000-20]",
    "cannot_act_on", "cannot_be_sent", "counters_of_their_own", "flood", "addresses_survive",
    "many_sources", "[bursts", "any_length", "instances_are", "wrong_time", "no_run_has", "damaged_give",
)  # fmt: skip
"""Parts of the names of tests that reach other parts of the core."""


def test_the_tests_of_the_core_run_clean_under_sanitizers() -> None:
    """One process for all of them: with sanitizers, its start takes as long as many tests."""
    done = run(*PYTEST, *FILES, "-k", " or ".join(NAMES))
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[:4000]
    (passed,) = re.findall(r"^(\d+) passed", done.stdout, re.MULTILINE)
    assert int(passed) >= 70
