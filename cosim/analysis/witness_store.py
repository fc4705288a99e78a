"""Witnesses that were found earlier: a search takes seconds to minutes, a check 0.3 s.

They are in the user's cache folder. Those of the shipped scenarios are files of the package, which
``make proofs`` writes. Nothing that is stored is believed: the checker proves each document again, for the
loop at hand. A file that is damaged, or another user's, counts as missing. What is stored counts for
searches that are not longer: the short search of a run may find larger bounds. That a search found nothing
is stored, too; this counts for the same version of noack.
"""

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

from flint import arb, arb_mat

from netem.core.file_access import create_folder, new_file, open_regular, remove_file
from noack.proof.elaborate.loop import Loop

SHIPPED, INDEX = Path(__file__).parent / "shipped_proofs", "index.json"
"""Proofs of the package, and the file that has their names by the loop's key."""
_FORM = "2"
"""Of the documents; another one has other keys."""
_MOST_BYTES, _MOST_FILES = 20_000_000, 300
_UNREADABLE = (OSError, ValueError, LookupError, TypeError, AttributeError, RuntimeError)
"""RuntimeError: there is no home, or the content is nested too deeply."""


class StoredSearch(NamedTuple):
    """What an earlier search found."""

    document: Mapping[str, object] | None
    reason: str = ""
    """Why there is no witness."""


class WitnessStore:
    """The file of a loop.

    Args:
        loop: its exact numbers are the key, so that names, seeds and durations do not matter; of a plant's
            equations the loop near 0, and the equations.
    """

    def __init__(self, loop: Loop | tuple[Loop, Mapping[str, object]]) -> None:
        key = json.dumps([_FORM, _exact(loop)])
        self.name = hashlib.sha256(key.encode()).hexdigest() + ".json"
        """The file's name."""

    def read(self, wanted: Sequence[str], most_work: float) -> StoredSearch | None:
        """Return what a search for some outputs with this limit of work would find; None: it is not known."""
        with suppress(*_UNREADABLE):
            if (found := _stored(self._read_shipped(), wanted, most_work)) is not None:
                return found
        with suppress(*_UNREADABLE), open_regular(_folder() / self.name) as file:
            if hasattr(os, "geteuid") and os.fstat(file.fileno()).st_uid != os.geteuid():
                return None
            return _stored(file.read(_MOST_BYTES), wanted, most_work)
        return None

    def _read_shipped(self) -> bytes:
        name: str = json.loads((SHIPPED / INDEX).read_bytes())[self.name.removesuffix(".json")]
        return (SHIPPED / name).read_bytes()

    def write(self, found: StoredSearch, wanted: Sequence[str], most_work: float) -> None:
        """Keep what a search found; without space or permission nothing is kept."""
        content = found._asdict() | {"noack": version("noack"), "wanted": wanted, "most_work": most_work}
        with suppress(OSError, ValueError, RuntimeError):
            create_folder(folder := _folder(), mode=0o700)
            with new_file(folder / self.name, mode=0o600) as file:
                file.write(json.dumps(content, allow_nan=False).encode())
            _remove_oldest(folder)


def _stored(text: bytes, wanted: Sequence[str], most_work: float) -> StoredSearch | None:
    """Return what a file says of a search; None: it says nothing, or another version found nothing."""
    content = json.loads(text)
    if not ({*wanted} <= {*content["wanted"]} and content["most_work"] >= most_work):
        return None
    if content["document"] is not None:
        return StoredSearch(content["document"])
    return StoredSearch(None, str(content["reason"])) if content["noack"] == version("noack") else None


def _folder() -> Path:
    """Return the folder of the store, by the XDG Base Directory Specification."""
    stated = Path(os.environ.get("XDG_CACHE_HOME", ""))
    base = stated if stated.is_absolute() else Path("~/.cache").expanduser()
    return base / "noack" / "witnesses"


def _remove_oldest(folder: Path) -> None:
    files = sorted(folder.glob("*.json"), key=lambda path: path.stat().st_mtime)
    for path in files[:-_MOST_FILES]:
        remove_file(path)


def _exact(value: object) -> object:
    """Return numbers, exactly, as lists of texts."""
    if isinstance(value, arb):
        return [str(part.man_exp()) for part in (value.mid(), value.rad())]
    if isinstance(value, arb_mat):
        return [value.ncols(), *map(_exact, value.entries())]
    if isinstance(value, tuple):
        return [*map(_exact, value)]
    return str(value)
