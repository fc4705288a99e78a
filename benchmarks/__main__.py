"""Benchmarks, one table each: ``python -m benchmarks [NAME ...] [--json FILE]``.

Each file of this folder whose name does not begin with an underscore declares one.
"""

import pkgutil
import sys
from importlib import import_module
from pathlib import Path

from benchmarks._programs import provide
from benchmarks._report import run

MODULES = [
    import_module(f"benchmarks.{found.name}")
    for found in pkgutil.iter_modules([str(Path(__file__).parent)])
    if not (found.ispkg or found.name.startswith("_"))
]

if __name__ == "__main__":
    provide()
    sys.exit(run([module.BENCHMARK for module in MODULES]))
