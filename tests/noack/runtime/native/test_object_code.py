"""Object code gives the results of the function it was compiled from, without the compiler."""

import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from noack.runtime.native.object_code import NativeFunction, compile_native, load, load_or_compile

CELL = np.dtype([("count", "<i8"), ("share", "<f8")])


class Tables(NamedTuple):
    grid: Any
    cell: Any
    factor: int
    negated: bool


def add_up(tables: Tables, other: Any, number: int) -> int:
    for row in range(tables.grid.shape[0]):
        for column in range(tables.grid.shape[1]):
            other[column] += tables.grid[row, column] * tables.factor
    tables.cell.count += number
    tables.cell.share = 0.5
    return -number if tables.negated else number


def arguments() -> tuple[Any, ...]:
    cells = np.zeros(3, CELL)
    return Tables(np.arange(6).reshape(2, 3), cells[1], 7, True), np.zeros(3, np.int64), 5


LOAD = """
import sys
from pathlib import Path
from noack.runtime.native.object_code import load
sys.exit(load(Path(sys.argv[1])) is None or "numba" in sys.modules)
"""


def test_object_code_is_kept_and_loaded_without_the_compiler(tmp_path: Path) -> None:
    file = tmp_path / "add_up.object"
    assert load(file) is None
    for compile_again in (True, False):  # the second time the file has it

        def examples(allowed: bool = compile_again) -> tuple[Any, ...]:
            assert allowed
            return arguments()

        function = load_or_compile(file, add_up, examples)
        tables, other, number = arguments()
        assert [function(tables, other, number), function(tables, other, 8)] == [-5, -8]
        assert (tables.cell["count"], tables.cell["share"]) == (13, 0.5)
        assert other.tolist() == [2 * 7 * (0 + 3), 2 * 7 * (1 + 4), 2 * 7 * (2 + 5)]
    done = subprocess.run([sys.executable, "-c", LOAD, file], timeout=60, check=False)
    assert done.returncode == 0


def test_damaged_code_is_not_loaded(tmp_path: Path) -> None:
    """LLVM would end the process."""
    code, file = compile_native(add_up, arguments()), tmp_path / "add_up.object"
    for damaged in (b"", b"\n", code[:-1], code[: len(code) // 2], code[:-1] + b"x"):
        file.write_bytes(damaged)
        assert load(file) is None
    file.write_bytes(code)
    assert isinstance(load(file), NativeFunction)


def test_arrays_with_gaps_are_refused(tmp_path: Path) -> None:
    function = NativeFunction(compile_native(add_up, arguments()))
    tables, other, number = arguments()
    with pytest.raises(ValueError, match="contiguous"):
        function(tables._replace(grid=tables.grid[:, ::2]), other, number)
