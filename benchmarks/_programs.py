"""Installs and compiles the programs that some benchmarks need, or says what is missing."""

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from benchmarks._report import MeasurementError

PACKAGES: Mapping[str, str] = {"cc": "gcc libc6-dev", "cyclictest": "rt-tests", "socat": "socat"}
"""Debian packages by program."""


def provide(packages: Mapping[str, str] = PACKAGES) -> list[str]:
    """Install missing programs, where root has apt-get; return those that are still missing.

    The rows of a missing program have no value: standard error names the packages first.
    """
    missing = [program for program in packages if shutil.which(program) is None]
    wanted = [word for program in missing for word in packages[program].split()]
    if wanted and shutil.which("apt-get") and os.geteuid() == 0:
        print(f"installing {', '.join(wanted)} ...", file=sys.stderr)
        install = ["apt-get", "install", "-y", "-qq", "--no-install-recommends", *wanted]
        for command in (["apt-get", "update", "-qq"], install):
            subprocess.run(command, stdout=subprocess.DEVNULL, check=False)
        missing = [program for program in missing if shutil.which(program) is None]
    if missing:
        names = " ".join(packages[program] for program in missing)
        print(
            f"not installed: {', '.join(missing)}; without them some goals are not measured "
            f"(Debian: sudo apt-get install {names})",
            file=sys.stderr,
        )
    return missing


def compiled(source: str, into: Path, *options: str) -> Path:
    """Compile a C file of this folder into another folder; return the path.

    Raises:
        MeasurementError: there is no C compiler, or it fails.
    """
    target = into / Path(source).stem
    if shutil.which("cc") is None:
        raise MeasurementError(f"{source} is written in C and cc is not installed")
    command = ["cc", "-O2", *options, "-o", str(target), str(Path(__file__).with_name(source))]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise MeasurementError(f"cc {source}: {done.stderr.strip()[:200]}")
    return target
