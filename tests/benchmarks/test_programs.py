"""Programs that a benchmark needs are installed by root, and named to others."""

import os
import shutil
import subprocess
from collections.abc import Sequence
from typing import Any

import pytest

from benchmarks.programs import provide


@pytest.mark.parametrize(
    ("root", "works", "missing"), [(True, True, []), (True, False, ["b"]), (False, True, ["b"])]
)
def test_a_missing_program_is_installed_or_named(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    root: bool,
    works: bool,
    missing: Sequence[str],
) -> None:
    present, commands = {"a", "apt-get"}, list[list[str]]()

    def execute(command: list[str], **_: Any) -> None:
        commands.append(command)
        if works and command[1] == "install":
            present.add("b")

    monkeypatch.setattr(shutil, "which", lambda name: name if name in present else None)
    monkeypatch.setattr(os, "geteuid", lambda: 0 if root else 1000)
    monkeypatch.setattr(subprocess, "run", execute)
    assert provide({"a": "package-a", "b": "package-b more"}) == missing
    assert [command[-2:] for command in commands[1:]] == [["package-b", "more"]] * root
    assert ("apt-get install package-b more" in capsys.readouterr().err) == bool(missing)


def test_nothing_is_installed_if_all_programs_are_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: pytest.fail("installs"))
    monkeypatch.setattr(shutil, "which", lambda name: name)
    assert provide() == []
