import shutil
import struct
from pathlib import Path

import numpy as np
import pytest

from noack.core.errors import MachineError
from noack.runtime.spool import SpoolWriter, read_chunks

ROW = np.dtype([("input", "<i8")])


def spool(folder: Path, writer: str, table: str, *batches: tuple[int, bytes]) -> Path:
    with_writer = SpoolWriter(folder, writer)
    for first, payload in batches:
        with_writer.append(table, first, payload)
    with_writer.close()
    return folder / f"{table}.{writer}"


def test_the_file_is_the_documented_sequence_of_chunks(tmp_path: Path) -> None:
    path = spool(tmp_path, "recorder", "plant_step", (7, b"abc"), (8, b"de"))
    expected = struct.pack("<QQ", 7, 3) + b"abc" + struct.pack("<QQ", 8, 2) + b"de"
    assert path.read_bytes() == expected


def test_an_incomplete_chunk_is_ignored(tmp_path: Path) -> None:
    batches = [(0, b"first"), (5, b"second")]
    path = spool(tmp_path, "recorder", "plant_step", *batches)
    whole = path.read_bytes()
    for size in range(len(whole)):
        path.write_bytes(whole[:size])
        assert list(read_chunks(tmp_path, "plant_step")) == batches[: int(size >= 16 + 5)]
    path.write_bytes(whole + struct.pack("<QQ", 11, 2**62))  # a damaged length takes no memory
    assert list(read_chunks(tmp_path, "plant_step")) == batches


@pytest.mark.parametrize("what", ["deleted", "moved", "replaced", "folder"])
def test_files_that_are_deleted_meanwhile_are_noticed(tmp_path: Path, what: str) -> None:
    folder = tmp_path / "spool"
    writer = SpoolWriter(folder, "recorder")
    writer.prepare(["step", "other"])
    writer.append("step", 0, b"abc")
    writer.require_present()
    path = folder / "step.recorder"
    if what == "folder":
        shutil.rmtree(folder)
    elif what == "moved":
        path.rename(tmp_path / "elsewhere")
    else:
        path.unlink()
        if what == "replaced":
            path.write_bytes(b"")
    writer.append("step", 3, b"de")  # the write succeeds, but the file has no name
    with pytest.raises(MachineError, match=r"/step\.recorder: was deleted or moved"):
        writer.require_present()
    writer.close()
