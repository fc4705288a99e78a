"""Installs the programs that some benchmarks need, or names their packages."""

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping

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
