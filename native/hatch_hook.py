"""Builds the core for wheels and editable installations; hatchling calls it (pyproject.toml)."""

import re
import runpy
import sysconfig
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class CoreHook(BuildHookInterface):
    """Adds the library and its declarations to a wheel."""

    PLUGIN_NAME = "custom"

    def dependencies(self) -> list[str]:
        """Return the further packages that a build needs: a compiler, if the machine has none."""
        build = self._build()
        try:
            build["compiler"]()
        except build["NoCompilerError"]:
            return ["ziglang>=0.13"]
        return []

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build the core in its place; the wheel is of this platform, and of every Python 3."""
        build = self._build()
        build["build"]()
        library = build["INTO"] / build["LIBRARY"]
        build_data["artifacts"] += [f"/noack/core/{build[name]}" for name in ("LIBRARY", "HEADER")]
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{_platform(library.read_bytes())}"

    def _build(self) -> dict[str, Any]:
        return runpy.run_path(str(Path(self.root) / "native" / "build.py"))


def _platform(library: bytes) -> str:
    """Return the tag of the platforms that can load a library (PEP 600).

    On Linux the symbols that it uses name the oldest version of glibc that has them.
    """
    own = re.sub("[-.]", "_", sysconfig.get_platform())
    minors = [int(minor) for minor in re.findall(rb"GLIBC_2\.(\d+)", library)]
    return own.replace("linux", f"manylinux_2_{max(*minors, 5)}", 1) if minors else own
