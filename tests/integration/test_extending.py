"""The extension of docs/extending.md, built and installed as a package, in programs of its own."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from netem.core.extension_points import NO_EXTENSIONS
from tests.helpers.pages import blocks

PAGE = "docs/extending.md"
_NAMED = re.compile(r"# ([\w/-]+\.\w+)\n")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the page's files; the package is installed in ``installed``."""
    for content in [*blocks(PAGE, "toml"), *blocks(PAGE, "python")]:
        named = _NAMED.match(content)
        assert named
        path = tmp_path / named[1]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    build = ["wheel", "--no-deps", "--no-build-isolation", "--no-index", "./noack-swing"]
    subprocess.run([*pip, *build], cwd=tmp_path, check=True)
    (wheel,) = tmp_path.glob("*.whl")
    assert wheel.name == "noack_swing-0.1.0-py3-none-any.whl"
    install = ["install", "--no-deps", "--no-index", "--target", "installed", wheel.name]
    subprocess.run([*pip, *install], cwd=tmp_path, check=True)
    return tmp_path


@pytest.mark.system
def test_the_documented_extension_is_built_installed_and_used(folder: Path) -> None:
    environment = {**os.environ, NO_EXTENSIONS: "", "PYTHONPATH": str(folder / "installed")}

    def noack(*words: str) -> str:
        program = [sys.executable, "-m", "cosim.cli", *words]
        done = subprocess.run(
            program, cwd=folder, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
        assert "warning" not in done.stderr
        return done.stdout

    noack("simulate", "swing.toml", "--no-report")
    noack("replay", "--json")
    noack("export", "--format", "peaks", "--out", "peaks.txt")
    first, second = (folder / "peaks.txt").read_text().splitlines()
    assert re.fullmatch(r"swing \w+ 0\.5", first)  # it begins at its largest angle
    assert re.fullmatch(r"swing \w+ [\d.]+", second)
