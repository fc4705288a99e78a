"""The name of a process's monotonic clock."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from noack.core import clock as host_clock
from noack.core.clock import clock_identity

_PRINT = "from noack.core.clock import clock_identity; print(clock_identity())"


def _elsewhere(*before: str) -> str:
    command = [*before, sys.executable, "-c", _PRINT]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def test_processes_of_a_machine_share_a_clock() -> None:
    assert clock_identity() == _elsewhere()


@pytest.mark.skipif(sys.platform != "linux" or os.geteuid() != 0, reason="needs root")
def test_another_time_namespace_is_another_clock() -> None:
    try:
        other = _elsewhere("unshare", "--time", "--monotonic=1", "--fork")
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("no time namespaces here")
    assert other != clock_identity()


def test_another_boot_is_another_clock(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found = clock_identity()
    (tmp_path / "boot_id").write_text("another\n")
    monkeypatch.setattr(host_clock, "_BOOT", tmp_path / "boot_id")
    assert clock_identity() != found


def test_a_system_without_boot_id_has_a_number(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(host_clock, "_BOOT", tmp_path / "absent")
    assert clock_identity() == clock_identity()
    assert clock_identity().startswith("machine ")
