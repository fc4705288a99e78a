"""Says how long compiling takes, and remembers it beside the compiled code for the next time."""

import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from netem.standard_error import say
from noack.core.code_cache import while_compiling


@contextmanager
def announced(what: str, folder: Path | None, typical_s: float) -> Iterator[None]:
    """Say that something is compiled while the context lasts, and how long that will take.

    Args:
        what: is compiled.
        folder: where it is kept; None if it is not.
        typical_s: how long it takes on a usual machine, for the first time on this one.
    """
    about_s = typical_s
    # Not in the folder, which is another one when the sources have changed.
    record = (
        None if folder is None else folder.with_name(f"{folder.name.rpartition('-')[0]}.seconds")
    )
    with suppress(OSError, ValueError):
        about_s = float(record.read_text()) if record is not None else typical_s
    say(while_compiling(what, folder is not None, about_s))
    began_s = time.monotonic()
    yield
    with suppress(OSError):
        if record is not None:
            record.write_text(f"{time.monotonic() - began_s:.1f}\n")
