"""Runs Python with the core built with ASan and UBSan, which end the process at the first mistake.

``python -m tests.native.sanitized_core FOLDER MODULE ARGUMENTS…`` is the child process: a module with
the core in that folder instead of noack's (``netem/libnetem.so`` and ``noack/libnoack.so``).
"""

import os
import runpy
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from native.build import LIBRARIES, SANITIZERS, NoCompilerError, build, compiler

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / ".cache" / "sanitized"
_OPTIONS = "abort_on_error=1:print_stacktrace=1"
_QUARANTINE = "quarantine_size_mb=16"
"""Freed memory is used again only after this much more was freed. With the default, 256 MB, the
kernel needs 3 s more for pages."""


class NoSanitizersError(Exception):
    """This machine's compiler has no sanitizers."""


def command(module: str, *arguments: str) -> tuple[list[str], Mapping[str, str]]:
    """Return command and environment of a child process that runs a module; build the core.

    Raises:
        NoSanitizersError: there is no compiler that has them.
    """
    try:
        command = [*compiler(), "-print-file-name=libasan.so"]
    except NoCompilerError as error:
        raise NoSanitizersError(str(error)) from None
    asan = subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
    if not Path(asan).is_absolute():
        raise NoSanitizersError(f"{command[0]} has no libasan.so")
    for library in LIBRARIES.values():
        build(library, FOLDER / library.name, *SANITIZERS)
    environment = os.environ | {
        "LD_PRELOAD": asan,
        "ASAN_OPTIONS": f"{_OPTIONS}:{_QUARANTINE}:detect_leaks=0",
        "UBSAN_OPTIONS": _OPTIONS,
        "PYTHONMALLOC": "malloc",  # so that ASan knows the bounds of what Python allocates
        "OPENBLAS_NUM_THREADS": "1",
    }
    return [sys.executable, "-m", __name__, str(FOLDER), module, *arguments], environment


def main() -> None:
    """Run a module with another core."""
    _, folder, module, *arguments = sys.argv
    from netem.core import core_library as network
    from noack.core import core_library as loop

    # Nothing has taken functions of the other core yet.
    ours = {name for name in sys.modules if name.startswith(("netem.", "noack."))}
    assert ours <= {
        "netem.core", "netem.core.core_library", "netem.core._core_header", "netem.core.errors",
        "noack.core", "noack.core.core_library", "noack.core._core_header",
    }  # fmt: skip
    for core_library, name in ((network, "netem"), (loop, "noack")):
        own = core_library.OWN
        core_library.core = own.functions = own.load(Path(folder) / name / own.path.name)
    sys.argv = [module, *arguments]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
