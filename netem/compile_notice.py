"""Announces a compilation and its expected duration, and stores the duration for the next time."""

import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from netem.standard_error import say
from noack.core.code_cache import while_compiling


@contextmanager
def announced(what: str, folder: Path | None, typical_s: float) -> Iterator[None]:
    """Print that code is compiled within the context, and the expected duration.

    ``typical_s`` is the duration until one has been measured on this machine; ``folder`` is the
    cache folder of the compiled code, if there is a cache.
    """
    about_s = typical_s
    # Not in the folder itself: its name changes with the sources.
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
