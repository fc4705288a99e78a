"""Files that come with noack, found by name: scenarios and campaigns."""

import difflib
from pathlib import Path

from noack.errors import CallerError


def find_shipped(name: str, folder: str) -> Path:
    """Return the path of a TOML file given by path, or by the name of a shipped one.

    Args:
        name: as the user gave it.
        folder: scenarios or campaigns.

    Raises:
        CallerError: a bare name that is none of the shipped ones.
    """
    path = Path(name)
    if path.exists() or path.suffix == ".toml":
        return path
    if (shipped := _place(folder) / f"{name}.toml").is_file():
        inside = shipped.is_relative_to(Path.cwd())
        return shipped.relative_to(Path.cwd()) if inside else shipped
    names = shipped_names(folder)
    if path.parent.name or not names:
        return path
    close = difflib.get_close_matches(name, names, n=1)
    hint = f"did you mean {close[0]}? There" if close else "there"
    kind = folder.removesuffix("s")
    raise CallerError(f"{name}: no such file, nor a shipped {kind}; {hint} are {', '.join(names)}")


def shipped_names(folder: str) -> list[str]:
    """Return the names of the scenarios or campaigns that come with noack."""
    return sorted(file.stem for file in _place(folder).glob("*.toml"))


def _place(folder: str) -> Path:
    """Where they lie: in the package that was installed, or beside it in the repository."""
    here = Path(__file__).parent
    return here / folder if (here / folder).is_dir() else here.parent / folder
