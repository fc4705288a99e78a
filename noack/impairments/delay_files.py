"""Files of delays: observed ones, and the distribution tables of ``tc``."""

import re
from collections.abc import Iterator
from pathlib import Path

from noack.settings.user_files import NamedFile

MAX_SAMPLES = 1_000_000
TABLE_SUFFIX = ".dist"
"""Suffix of tc's distribution tables."""
_TABLE_SCALE = 8192
"""The number that represents 1 in a table of tc."""
_UNITS_S = {"": 1.0, "s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_DELAY = re.compile(r"([+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)\s*([a-z]*)")


def read_samples(
    name: str, jitter_s: float, most_s: float, folder: Path, place: str
) -> tuple[float, ...]:
    """Return the delays in a file, in seconds; the jitter scales a distribution table.

    Args:
        name: name of the file, relative to ``folder``.
        jitter_s: the jitter.
        most_s: maximum delay.
        folder: the folder.
        place: position of the file name in the settings, for messages.

    Raises:
        CallerError: one line; the file cannot be read, or has wrong content.
    """
    file = NamedFile(name, folder, place)
    if Path(name).suffix == TABLE_SUFFIX:
        if jitter_s == 0:
            file.wrong("a distribution table is scaled by the jitter, which is 0; give a jitter")
        samples_s = [jitter_s * entry / _TABLE_SCALE for entry in _table(file)]
    else:
        if jitter_s != 0:
            file.wrong(
                "observed delays are taken as they are, and have no jitter beside them; "
                f"a distribution table of tc is named *{TABLE_SUFFIX}"
            )
        samples_s = list(_observed_s(file))
    if not 2 <= len(samples_s) <= MAX_SAMPLES:
        file.wrong(f"has {len(samples_s)} delays; expected 2 to {MAX_SAMPLES}")
    if max(map(abs, samples_s)) > most_s:
        file.wrong(f"has a delay beyond {most_s:g} s")
    return tuple(samples_s)


def _table(file: NamedFile) -> Iterator[int]:
    for number, line in file.lines():
        for word in line.split():
            if not re.fullmatch("-?[0-9]{1,5}", word):
                file.wrong(f"line {number}: {word[:20]}: expected whole numbers, 8192 for 1")
            yield int(word)


def _observed_s(file: NamedFile) -> Iterator[float]:
    for number, line in file.lines():
        found = _DELAY.fullmatch(line)
        scale = _UNITS_S.get(found[2]) if found else None
        if found is None or scale is None:
            file.wrong(f"line {number}: {line[:20]}: expected one delay, e.g. 0.0125 or 12.5ms")
        yield float(found[1]) * scale
