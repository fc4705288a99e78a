"""Measuring a run while it changes its files or ends."""

import shutil
from pathlib import Path

import pytest

from benchmarks.soak.watch import size_bytes


def test_a_folder_may_vanish_while_it_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "log").write_bytes(bytes(8192))
    (tmp_path / "spool").mkdir()
    (tmp_path / "spool" / "rows").write_bytes(bytes(8192))
    assert size_bytes(tmp_path) >= 2 * 8192
    look = Path.stat

    def look_once_more(path: Path) -> object:
        if path.name == "rows":
            shutil.rmtree(tmp_path / "spool", ignore_errors=True)
        return look(path)

    monkeypatch.setattr(Path, "stat", look_once_more)
    assert 8192 <= size_bytes(tmp_path) < 2 * 8192
