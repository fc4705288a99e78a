"""Files and classes that a setting names."""

from pathlib import Path

import pytest

import noack
from netem.core.errors import CallerError
from netem.core.named_file import NamedFile


def test_only_regular_files_are_read(tmp_path: Path) -> None:
    file = NamedFile("/dev/zero", tmp_path, "run.toml: network.loss")
    for read in (file.content, file.sha256):
        with pytest.raises(CallerError, match=r"cannot be read: not a regular file$"):
            read()


class Car:
    """A user's plant class; only its name is used."""


def test_a_class_is_given_by_its_file_and_name() -> None:
    with pytest.raises(CallerError, match="Car: a class is given by its file and its name: "):
        noack.load("double_integrator", {"plant.system": Car})
