"""Packages that are installed in a folder, and programs that find them there."""

import os
import subprocess
import sys
from pathlib import Path

from netem.core.extension_points import NO_EXTENSIONS


def install(folder: Path, name: str, entry_points: str, **modules: str) -> None:
    """Install a package as pip does: modules, beside a folder that describes the package."""
    about = folder / f"{name.replace('-', '_')}-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(entry_points)
    for module, text in modules.items():
        (folder / f"{module}.py").write_text(text)


def run(folder: Path, *words: str, **environment: str) -> tuple[str, list[str]]:
    """Run Python where the packages of a folder are installed; return its output and its warnings."""
    done = subprocess.run(
        [sys.executable, *words],
        env={**os.environ, NO_EXTENSIONS: "", "PYTHONPATH": str(folder), **environment},
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.strip(), done.stderr.splitlines()
