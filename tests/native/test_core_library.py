"""The loader of the core, and the names that Python has for the things of native/noack.h."""

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from noack.core.core_library import (
    LIBRARY,
    address_of,
    core,
    dtype_of,
    ffi,
    load_core,
    pointer_to,
)
from noack.core.errors import CallerError
from noack.impairments.feature import StageTables
from noack.impairments.link_settings import Counters, RecordedDecision
from noack.protocol.record_tables import Fate
from tests.netem.feature_examples import IMPAIRED, names_file

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("name", [
    "noack_decision", "noack_recorded", "noack_stage_memory", "noack_flow", "noack_queue",
    "noack_counters", "noack_window",
])  # fmt: skip
def test_a_row_type_has_the_fields_of_its_structure(name: str) -> None:
    rows = np.zeros(2, dtype_of(name))
    assert rows.itemsize == ffi.sizeof(name)
    first = pointer_to(rows, f"{name} *")
    for number, field in enumerate(rows.dtype.names or ()):
        setattr(first[1], field, number)
        assert rows[1][field] == number
    assert not rows[0].tobytes().strip(b"\0")


def test_a_pointer_has_the_address_of_its_array() -> None:
    numbers = np.arange(6, dtype=np.int64)
    pointer = pointer_to(numbers, "int64_t *")
    assert (address_of(pointer), pointer[5]) == (numbers.ctypes.data, 5)
    with pytest.raises(ValueError, match="contiguous"):
        pointer_to(numbers[::2], "int64_t *")


def test_a_missing_or_broken_or_other_library_is_refused_in_one_line(tmp_path: Path) -> None:
    own = ffi.string(core.noack_sources())
    other = LIBRARY.read_bytes().replace(own, own[::-1])
    for number, content in enumerate((None, b"", b"no library", other)):
        path = tmp_path / f"{number}.so"
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(CallerError, match="not of the same" if number == 3 else "") as error:
            load_core(path)
        assert str(path) in str(error.value)
        assert "make setup" in str(error.value)
        assert str(error.value).isprintable()


def test_a_command_without_the_core_says_so_without_a_traceback(tmp_path: Path) -> None:
    for package in ("noack", "cosim", "netem", "plant_server", "sensor_node", "controller_node"):
        ignored = shutil.ignore_patterns("__pycache__", "_core_header.py")
        shutil.copytree(ROOT / package, tmp_path / package, ignore=ignored)
    done = subprocess.run(
        [sys.executable, "-c", "from cosim.cli import main; main()", "check", "lane_following"],
        cwd=tmp_path, capture_output=True, text=True, check=False, timeout=100,
    )  # fmt: skip
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("noack: noack's core in C")
    assert "make setup" in line


def constants(name: str) -> dict[str, int]:
    """Return the constants of an enumeration."""
    return {word: number for number, word in ffi.typeof(f"enum {name}").elements.items()}


def test_python_has_the_numbers_and_fields_of_c() -> None:
    assert constants("noack_fate") == {f"NOACK_{fate.name}": fate.value for fate in Fate}
    assert dtype_of("noack_counters").names == tuple(Counters.__dataclass_fields__)
    assert dtype_of("noack_recorded").names == RecordedDecision._fields


def test_each_stage_kind_has_a_file_in_c_and_a_feature_in_python() -> None:
    kinds = [
        name.removeprefix("NOACK_").lower()
        for name, number in constants("noack_stage_kind").items()
        if number != core.NOACK_STAGE_KINDS
    ]
    assert {path.stem for path in (ROOT / "native" / "impairments").glob("*.c")} == set(kinds)
    made = [one.stage(StageTables()) for one in IMPAIRED if not names_file(one)]
    assert {stage.kind for stage in made if stage is not None} == set(kinds)
