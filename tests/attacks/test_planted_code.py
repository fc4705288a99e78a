"""noack neither loads nor imports code from folders to which another user can write."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from cosim.output.viewer.recording_viewer import LiveView

ROOT = Path(__file__).parents[2]
PACKAGES = ("noack", "plant_server", "sensor_node", "controller_node", "netem", "cosim", "tools")
SHADOWED = ("socket", "logging", "multiprocessing", "http", "pickle", "concurrent", "fcntl")
POOL = """
from cosim.live.processes.process_pool import processes
if __name__ == "__main__":
    with processes(2) as pool:
        print(pool.submit(pow, 2, 5).result())
"""


@pytest.fixture
def planted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Enter a folder with modules that write a trace file when imported; return its path."""
    folder, trace = tmp_path / "planted", tmp_path / "trace"
    folder.mkdir()
    for name in SHADOWED:
        (folder / f"{name}.py").write_text(f"open({str(trace)!r}, 'a').write('{name} ')\n")
    monkeypatch.chdir(folder)
    return trace


def test_planted_modules_are_imported_without_protection(planted: Path) -> None:
    subprocess.run([sys.executable, "-c", "import pickle"], check=True)
    assert planted.read_text() == "pickle "


def test_the_live_viewers_process_imports_no_planted_module(planted: Path) -> None:
    recording = planted.with_name("recording.rrd")
    recording.write_bytes(b"RRF2")
    live = LiveView(native=False)
    live.show(recording)
    status = live.status
    live.close()
    assert not planted.exists(), planted.read_text()
    assert status.startswith("live view: http://127.0.0.1:")


def test_workers_import_no_planted_module(planted: Path) -> None:
    """The program ``noack`` starts them; its own folder is not the current folder."""
    program = planted.with_name("program.py")
    program.write_text(POOL)
    result = subprocess.run(
        [sys.executable, program], capture_output=True, text=True, check=False,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert not planted.exists(), planted.read_text()
    assert result.stdout == "32\n", result.stderr


def test_only_one_function_starts_the_interpreter() -> None:
    """A call that names the interpreter directly could omit ``-P``."""
    naming = [
        str(path.relative_to(ROOT))
        for package in PACKAGES
        for path in sorted((ROOT / package).rglob("*.py"))
        if re.search(r"\bsys\.executable\b", path.read_text())
    ]
    assert naming == ["netem/core/system_processes.py"]
