"""Wheels, built from their source distributions without downloads, and installed without the repository."""

import json
import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from email import message_from_bytes
from importlib.metadata import Distribution, distribution
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement

from native.build import HEADER, LIBRARIES
from tests.helpers.live_runs import PATIENCE_S

ROOT = Path(__file__).parents[2]
ENVIRONMENT = {
    name: value
    for name, value in os.environ.items()
    if name not in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
}


def uv(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run uv; skip the test without it."""
    program = shutil.which("uv", path=str(Path(sys.executable).parent)) or shutil.which("uv")
    if program is None:
        pytest.skip("uv is not installed")
    return subprocess.run(
        [program, *map(str, arguments)], env=ENVIRONMENT, capture_output=True, text=True,
        check=False, timeout=250,
    )  # fmt: skip


def built(source: Path, out: Path, kind: str) -> Path:
    """Build with the installed packages and without downloads; return the file that was built.

    Args:
        source: a folder with a pyproject.toml.
        out: a folder without files.
        kind: "sdist" or "wheel".
    """
    out.mkdir(exist_ok=True)
    done = uv("build", f"--{kind}", "--no-build-isolation", "--python", sys.executable, source,
              "--out-dir", out)  # fmt: skip
    assert done.returncode == 0, done.stderr
    (file,) = out.glob("*.whl" if kind == "wheel" else "*.tar.gz")
    return file


def wheel_of_sdist(source: Path, scratch: Path, library: str, folder: str) -> Path:
    """Build a source distribution in an empty folder, and the wheel from what it contains.

    ``library`` is the name of its library in C, which is given to ``folder`` in it. It is built again
    only if the source distribution has other sources.
    """
    sdist = built(source, scratch / "sdist", "sdist")
    with tarfile.open(sdist) as file:
        file.extraction_filter = getattr(tarfile, "data_filter", None)  # Python 3.11.4 and later have it
        file.extractall(scratch / "sources")
    (sources,) = (scratch / "sources").iterdir()
    own = LIBRARIES[library]
    for name in (own.file, HEADER):
        shutil.copyfile(own.folder / name, sources / folder / name)
    return built(sources, scratch / "wheel", "wheel")


def content(wheel: Path) -> dict[str, int]:
    """Return the files of a wheel, each with its checksum."""
    with zipfile.ZipFile(wheel) as file:
        return {entry.filename: entry.CRC for entry in file.infolist()}


def files_below(folder: Path) -> set[str]:
    """Return the files that a package has in its wheel, relative to the folder above it."""
    return {
        str(path.relative_to(folder.parent))
        for path in folder.rglob("*")
        if path.is_file() and path.suffix not in (".pyc", ".nbi", ".nbc")
    }


def requirements(wheels: Iterable[Path], *extras: str) -> list[Distribution]:
    """Return the installed packages that wheels need, also indirectly, but the wheels themselves."""
    needed: dict[str, Distribution] = {}
    waiting: list[tuple[Requirement, str]] = []
    for wheel in wheels:
        with zipfile.ZipFile(wheel) as file:
            (about,) = (name for name in file.namelist() if name.endswith(".dist-info/METADATA"))
            texts = message_from_bytes(file.read(about)).get_all("Requires-Dist", [])
        waiting += [(Requirement(text), of) for text in texts for of in ("", *extras)]
    while waiting:
        requirement, extra = waiting.pop()
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": extra}):
            continue
        new = requirement.name not in needed
        installed = needed.setdefault(requirement.name, distribution(requirement.name))
        assert requirement.specifier.contains(installed.version), requirement
        of_it = [*([""] if new else []), *requirement.extras]
        waiting += [(Requirement(text), of) for text in installed.requires or () for of in of_it]
    return [package for name, package in needed.items() if name != "noack-netem"]


@dataclass(frozen=True)
class Installed:
    """An environment with a command, and a working folder."""

    program: Path
    folder: Path

    @property
    def python(self) -> Path:
        """The environment's interpreter."""
        return self.program.with_name("python")

    def __call__(self, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
        """Run the command."""
        return self.run(self.program, *arguments)

    def run(self, *words: str | Path) -> subprocess.CompletedProcess[str]:
        """Run a program in the working folder."""
        return subprocess.run(
            [*map(str, words)], cwd=self.folder, env=ENVIRONMENT, capture_output=True,
            text=True, check=False, timeout=PATIENCE_S,
        )  # fmt: skip

    def json(self, *arguments: str) -> dict[str, Any]:
        """Return what the command prints with --json."""
        done = self(*arguments, "--json")
        assert done.returncode == 0, done.stderr
        answer: dict[str, Any] = json.loads(done.stdout)
        return answer


def install(
    place: Path, command: str, wheels: Iterable[Path], *extras: str, also: Iterable[str] = ()
) -> Installed:
    """Install wheels into a new environment that has what they need, ``also`` these packages, no others."""
    wheels = list(wheels)
    python = place / "env" / "bin" / "python"
    made = uv("venv", "--python", sys.executable, place / "env")
    assert made.returncode == 0, made.stderr
    (packages,) = (place / "env").glob("lib/python*/site-packages")
    for package in (*requirements(wheels, *extras), *map(distribution, also)):
        for name in {path.parts[0] for path in package.files or ()} - {"..", "__pycache__"}:
            if not (packages / name).exists():
                (packages / name).symlink_to(Path(str(package.locate_file(name))))
    done = uv("pip", "install", "--python", python, "--offline", "--no-deps", *wheels)
    assert done.returncode == 0, done.stderr
    (place / "work").mkdir()
    return Installed(place / "env" / "bin" / command, place / "work")
