"""What a node on a board needs of the core compiles without a system, and calls little."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from native.build import HERE, NO_COMPILER

pytestmark = pytest.mark.system
BARE = {"memcpy", "memmove", "memset", "memcmp"}
"""What compilers expect of every system."""
LIBM = {"fabs", "floor", "fmax", "fmin", "frexp", "ldexp", "sqrt"}
"""Functions of exact results: the bits do not depend on the library."""
ARM = "arm-none-eabi-"


@pytest.mark.parametrize("tools", ["", ARM], ids=["own", "board"])
def test_the_machines_need_no_system_and_take_no_names_of_a_firmware(tools: str, tmp_path: Path) -> None:
    if tools and shutil.which(f"{tools}gcc") is None:
        pytest.skip("arm-none-eabi-gcc is not installed")
    compiler = {"CC": f"{tools}gcc -mcpu=cortex-m4 -mthumb -Werror"} if tools else {}
    build, machines = str(HERE / "build.py"), str(tmp_path / "machines.o")
    command = [sys.executable, build, "--machines", machines]
    done = subprocess.run(command, env=os.environ | compiler, check=False)
    if done.returncode == NO_COMPILER or shutil.which(f"{tools}nm") is None:
        pytest.skip("there is no C compiler, or no nm")
    assert done.returncode == 0
    named = subprocess.run([f"{tools}nm", "-u", machines], capture_output=True, text=True, check=True)
    needed = {line.split()[-1] for line in named.stdout.splitlines()}
    assert {symbol for symbol in needed if not symbol.startswith("__aeabi_")} <= BARE | LIBM
    assert "sqrt" in needed
    named = subprocess.run(
        [f"{tools}nm", "-g", "--defined-only", machines], capture_output=True, text=True, check=True
    )
    # Other names may be a firmware's own.
    defined = {line.split()[-1] for line in named.stdout.splitlines()}
    assert {symbol for symbol in defined if not symbol.lower().startswith("noack_")} == set()
