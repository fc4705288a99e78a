"""What macOS and Windows have of noack does without the modules that only POSIX has."""

import subprocess
import sys
from pathlib import Path

PROGRAM = """
import sys
import asyncio, multiprocessing.spawn, pyarrow.parquet, scipy.optimize, scipy.stats, subprocess, typer, zenoh

class Missing:
    def find_spec(self, name, *_):
        if name in {"fcntl", "grp", "pwd", "resource", "termios", "tty"}:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

for name in ("fcntl", "grp", "pwd", "resource", "termios", "tty"):
    sys.modules.pop(name, None)
sys.meta_path.insert(0, Missing())
import noack

run = noack.simulate(noack.load("lane_following", {"horizon_s": 1.0, "certificate.prove": False}))
assert run.ok and run.replay().bit_exact
assert noack.certify("double_integrator", search=False).schedule is not None
"""


def test_simulation_replay_and_certificates_need_no_module_of_posix(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
