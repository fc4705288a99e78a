"""Files that come with noack, found by name: scenarios and campaigns."""

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
    here = Path(__file__).parent
    for place in (here.parent / folder, here / folder):
        if (shipped := place / f"{name}.toml").is_file():
            inside = shipped.is_relative_to(Path.cwd())
            return shipped.relative_to(Path.cwd()) if inside else shipped
        if place.is_dir() and not path.parent.name:
            names = ", ".join(sorted(file.stem for file in place.glob("*.toml")))
            kind = folder.removesuffix("s")
            raise CallerError(f"{name}: no such file, nor a shipped {kind}; there are {names}")
    return path
