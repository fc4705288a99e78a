"""Files that come with noack and its extensions, found by name: scenarios and campaigns."""

import re
import tomllib
from pathlib import Path
from typing import NamedTuple

from netem.core.errors import CallerError, did_you_mean, shortened
from netem.core.extension_points import missing_extension
from netem.core.file_access import shipped_files

KINDS = ("scenarios", "campaigns")
"""Kinds of shipped files, and their folders."""

_LIST = "`noack scenarios` lists the shipped ones"

_SCHEMA = "#:schema"
"""Begins the line that names the schema for editors; a copy does not have it."""

_FILE = re.compile(r'^file = "([\w/]+\.\w+)"', re.MULTILINE)
"""A file beside a scenario, which a copy of the scenario names by its absolute path."""


class ShippedFile(NamedTuple):
    """A file that comes with noack."""

    name: str
    description: str
    path: Path


def find_shipped(name: str, folder: str) -> Path:
    """Return the path of a TOML file given by path, or by the name of a shipped one.

    Args:
        name: as the user gave it; without .toml it may also be that of a file in the current folder.
        folder: scenarios or campaigns.

    Raises:
        CallerError: a name without a folder that is neither a file nor a shipped one.
    """
    if not name:
        raise CallerError(f"no {folder.removesuffix('s')} is named: give a file or a shipped one")
    path, names = Path(name), shipped_names(folder)
    try:
        exists = path.exists() and not (path.is_dir() and name in names)
    except OSError:  # the name is too long
        exists = False
    if exists or (path.parent.name and name not in names) or not names:
        return path
    if name in names:
        return _path_of(name, folder)
    if (own := Path(f"{name}.toml")).is_file():
        return own
    kind = folder.removesuffix("s")
    for other in KINDS:
        if name in shipped_names(other):
            raise CallerError(f"{name}: a shipped {other.removesuffix('s')}, not a {kind}")
    if missing := missing_extension(f"noack.{folder}", name):
        raise CallerError(f"{name}: {missing}")
    if path.suffix == ".toml":
        names += sorted(map(str, Path().glob("*.toml")))
    hint = did_you_mean(name, names) or _LIST
    raise CallerError(f"{shortened(name)}: no such file, nor a shipped {kind}; {hint}")


def shipped_names(folder: str) -> list[str]:
    """Return the names of the scenarios or campaigns that come with noack."""
    return [*shipped_files(folder)]


def all_shipped(folder: str) -> list[ShippedFile]:
    """Return the scenarios or campaigns that come with noack, by name."""
    paths = [_path_of(name, folder) for name in shipped_names(folder)]
    return [ShippedFile(path.stem, _description_in(path), path) for path in paths]


def _description_in(path: Path) -> str:
    """Return the description in a file, which an extension's may lack: also if it is not TOML."""
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        return f"not a TOML file: {error}"
    return str(content.get("description", ""))


def text_of(name: str) -> str:
    """Return the text of a shipped scenario or campaign, to be copied.

    Raises:
        CallerError: there is no such file.
    """
    for folder in KINDS:
        if name in shipped_names(folder):
            path = _path_of(name, folder)
            lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
            text = "".join(line for line in lines if not line.startswith(_SCHEMA))
            return _FILE.sub(rf'file = "{path.absolute().parent}/\1"', text)
    names = [known for folder in KINDS for known in shipped_names(folder)]
    raise CallerError(f"{shortened(name)}: not a shipped file; {did_you_mean(name, names) or _LIST}")


def _path_of(name: str, folder: str) -> Path:
    """Return the path of a shipped file, relative to the working directory if inside it."""
    path = shipped_files(folder)[name]
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path
