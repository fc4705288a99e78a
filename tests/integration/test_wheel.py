"""The built and installed package works without the repository."""

import json
import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from dataclasses import dataclass
from email import message_from_bytes
from importlib.metadata import Distribution, distribution
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement

from native.build import HEADER, INTO, LIBRARY
from tests.helpers.live_runs import EPHEMERAL, PATIENCE_S

pytestmark = [pytest.mark.system]
ROOT = Path(__file__).parents[2]
ENVIRONMENT = {
    name: value
    for name, value in os.environ.items()
    if name not in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
}


def uv(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    program = shutil.which("uv", path=str(Path(sys.executable).parent)) or shutil.which("uv")
    if program is None:
        pytest.skip("uv is not installed")
    return subprocess.run(
        [program, *map(str, arguments)], env=ENVIRONMENT, capture_output=True, text=True,
        check=False, timeout=250,
    )  # fmt: skip


def built(*arguments: str | Path) -> Path:
    """Build with the installed packages and without downloads; return the wheel."""
    out = Path(arguments[-1])
    done = uv("build", "--no-build-isolation", "--python", sys.executable, *arguments)
    assert done.returncode == 0, done.stderr
    (wheel,) = out.glob("*.whl")
    return wheel


@pytest.fixture(scope="module")
def dist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the sdist and the wheel built from it.

    The core is given to it: it is built again only if the sdist has other sources.
    """
    out, into = tmp_path_factory.mktemp("dist"), tmp_path_factory.mktemp("sources")
    done = uv("build", "--sdist", "--no-build-isolation", "--python", sys.executable, ROOT,
              "--out-dir", out)  # fmt: skip
    assert done.returncode == 0, done.stderr
    (sdist,) = out.glob("*.tar.gz")
    with tarfile.open(sdist) as file:
        file.extraction_filter = getattr(tarfile, "data_filter", None)  # Python 3.11.4 and later have it
        file.extractall(into)
    (sources,) = into.iterdir()
    for name in (LIBRARY, HEADER):
        shutil.copyfile(INTO / name, sources / "netem" / "core" / name)
    built("--wheel", sources, "--out-dir", out)
    return out


@dataclass(frozen=True)
class Installed:
    """An environment with noack installed, and a working folder."""

    program: Path
    folder: Path

    def __call__(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [self.program, *arguments], cwd=self.folder, env=ENVIRONMENT, capture_output=True,
            text=True, check=False, timeout=PATIENCE_S,
        )  # fmt: skip

    def json(self, *arguments: str) -> dict[str, Any]:
        done = self(*arguments, "--json")
        assert done.returncode == 0, done.stderr
        answer: dict[str, Any] = json.loads(done.stdout)
        return answer


def requirements(wheel: Path) -> list[Distribution]:
    """Return the installed packages that a wheel needs without extras, also indirectly."""
    with zipfile.ZipFile(wheel) as file:
        (about,) = (name for name in file.namelist() if name.endswith(".dist-info/METADATA"))
        texts = message_from_bytes(file.read(about)).get_all("Requires-Dist", [])
    needed: dict[str, Distribution] = {}
    waiting = [(Requirement(text), "") for text in texts]
    while waiting:
        requirement, extra = waiting.pop()
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": extra}):
            continue
        new = requirement.name not in needed
        installed = needed.setdefault(requirement.name, distribution(requirement.name))
        assert requirement.specifier.contains(installed.version), requirement
        extras = [*([""] if new else []), *requirement.extras]
        waiting += [(Requirement(text), of) for text in installed.requires or () for of in extras]
    return [*needed.values()]


@pytest.fixture(scope="module")
def noack(dist: Path, tmp_path_factory: pytest.TempPathFactory) -> Installed:
    """The wheel, in an environment that has the packages that it needs and no others."""
    (wheel,) = dist.glob("*.whl")
    place = tmp_path_factory.mktemp("clean")
    python = place / "env" / "bin" / "python"
    made = uv("venv", "--python", sys.executable, place / "env")
    assert made.returncode == 0, made.stderr
    (packages,) = (place / "env").glob("lib/python*/site-packages")
    for package in requirements(wheel):
        for name in {path.parts[0] for path in package.files or ()} - {"..", "__pycache__"}:
            (packages / name).symlink_to(Path(str(package.locate_file(name))))
    done = uv("pip", "install", "--python", python, "--offline", "--no-deps", wheel)
    assert done.returncode == 0, done.stderr
    (place / "work").mkdir()
    return Installed(place / "env" / "bin" / "noack", place / "work")


def test_the_sdist_makes_the_same_wheel_as_the_repository(dist: Path, tmp_path: Path) -> None:
    (from_sdist,) = dist.glob("*.whl")
    from_tree = built("--wheel", ROOT, "--out-dir", tmp_path)

    def content(wheel: Path) -> dict[str, int]:
        with zipfile.ZipFile(wheel) as file:
            return {entry.filename: entry.CRC for entry in file.infolist()}

    assert content(from_sdist) == content(from_tree)


def test_the_wheel_contains_the_packages_and_their_data_only(dist: Path) -> None:
    (wheel,) = dist.glob("*.whl")
    with zipfile.ZipFile(wheel) as file:
        names = set(file.namelist())
    for folder in ("scenarios", "campaigns"):
        paths = (ROOT / folder).rglob("*")
        kept = {path for path in paths if path.suffix in (".toml", ".csv", ".md")}
        assert {f"cosim/{path.relative_to(ROOT)}" for path in kept} <= names
    packages = (
        "noack",
        "plant_server",
        "sensor_node",
        "controller_node",
        "netem",
        "cosim",
        "noack_kernel",
        "noack_gains",
        "noack_equations",
        "noack_verify",
    )
    for package in packages:
        root = ROOT / "checker" if (ROOT / "checker" / package).exists() else ROOT
        files = {
            str(path.relative_to(root))
            for path in (root / package).rglob("*")
            if path.is_file() and path.suffix not in (".pyc", ".nbi", ".nbc")
        }
        assert files <= names
    (about,) = {name.partition("/")[0] for name in names} - set(packages)
    assert about.endswith(".dist-info")
    assert not [name for name in names if "__pycache__" in name]


def test_the_installed_wheel_runs_without_the_repository(noack: Installed) -> None:
    assert noack("--version").stdout.startswith("noack ")
    run = noack.json("demo", *EPHEMERAL, "--set", "horizon_s=0.5", "--report")
    assert run["exit"]["status"] == 0
    assert run["loops"][0]["replay"]["bit_exact"]
    report = (noack.folder / "runs" / "latest" / "report.html").read_text(encoding="utf-8")
    assert report.count("<figure") == 9
    assert "completed 0.5 s" in report
    view = noack("view")
    assert (view.returncode, view.stderr.count("\n")) == (2, 1)
    assert "pip install 'noack[viewer]'" in view.stderr
    assert noack("netem", "--explain", "loss", "5%").returncode == 0
    doctor = json.loads(noack("doctor", *EPHEMERAL, "--seconds", "0.1", "--json").stdout)
    assert doctor["measured"]["viewer"] is None
