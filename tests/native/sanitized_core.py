"""Runs Python with the core built with ASan and UBSan, which end the process at the first mistake.

``python -m tests.native.sanitized_core LIBRARY MODULE ARGUMENTS…`` is the child process: a module
with that core instead of noack's.
"""

import os
import runpy
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from native.build import LIBRARY, SANITIZERS, NoCompilerError, build, compiler

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
    build(FOLDER, *SANITIZERS)
    environment = os.environ | {
        "LD_PRELOAD": asan,
        "ASAN_OPTIONS": f"{_OPTIONS}:{_QUARANTINE}:detect_leaks=0",
        "UBSAN_OPTIONS": _OPTIONS,
        "PYTHONMALLOC": "malloc",  # so that ASan knows the bounds of what Python allocates
        "OPENBLAS_NUM_THREADS": "1",
    }
    library = str(FOLDER / LIBRARY)
    return [sys.executable, "-m", __name__, library, module, *arguments], environment


def main() -> None:
    """Run a module with another core."""
    _, library, module, *arguments = sys.argv
    from netem.core import core_library

    # Nothing has taken functions of the other core yet.
    ours = {name for name in sys.modules if name.startswith(("netem.", "noack."))}
    assert ours <= {
        f"netem.{name}" for name in ("core", "core.core_library", "core._core_header", "core.errors")
    }
    core_library.core = core_library.load_core(Path(library))
    sys.argv = [module, *arguments]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
