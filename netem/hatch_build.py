"""Builds the library in C for wheels and editable installations; hatchling calls it (pyproject.toml).

noack-netem and noack have this file, each with its library and the folder for it (``self.config``).
``native/`` is in the folder that is built, but beside this one for noack-netem in the repository.
"""

import os
import re
import runpy
import shutil
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class CoreHook(BuildHookInterface[Any]):
    """Adds the library and its declarations to a wheel."""

    PLUGIN_NAME = "custom"
    _scratch: Path | None = None

    def dependencies(self) -> list[str]:
        """Return the further packages that a build needs: a compiler, if the machine has none."""
        build = self._build()
        try:
            build["compiler"](os.environ.get("NOACK_PLATFORM", build["OWN"]))
        except build["NoCompilerError"]:
            return ["ziglang>=0.13"]
        return []

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build the core; the wheel is of one platform, and of every Python 3.

        It is this machine's, with the core in its place, or that of $NOACK_PLATFORM.
        """
        build = self._build()
        tag = os.environ.get("NOACK_PLATFORM")
        library, place = build["LIBRARIES"][self.config["library"]], self.config["folder"]
        folder = Path(tempfile.mkdtemp(prefix="noack-core-")) if tag else Path(self.root) / place
        if tag is None:
            build["build"](library, folder)
            tag = _platform((folder / library.file).read_bytes())
        else:
            build["build"](library, folder, target=tag)
            self._scratch = folder
        for name in (library.file, build["HEADER"]):
            build_data["force_include"][str(folder / name)] = f"{place}/{name}"
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{tag}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove what was built for another platform."""
        if self._scratch:
            shutil.rmtree(self._scratch)

    def _build(self) -> dict[str, Any]:
        root = Path(self.root)
        within = root / "native" / "build.py"
        return runpy.run_path(str(within if within.exists() else root.parent / "native" / "build.py"))


def _platform(library: bytes) -> str:
    """Return the tag of the platforms that can load a library (PEP 600).

    On Linux the symbols that it uses name the oldest version of glibc that has them.
    """
    own = re.sub("[-.]", "_", sysconfig.get_platform())
    minors = [int(minor) for minor in re.findall(rb"GLIBC_2\.(\d+)", library)]
    return own.replace("linux", f"manylinux_2_{max(*minors, 5)}", 1) if minors else own
