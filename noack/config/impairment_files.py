"""Files that settings name: loss traces, observed delays, distribution tables of ``tc``."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from noack.config.impairments import (
    MAX_SCRIPT,
    MOST_DELAY_S,
    Delay,
    Impairment,
    LinkSettings,
    Loss,
    LossOf,
    ScriptedLoss,
    TraceLoss,
)
from noack.settings.named_file import NamedFile

MAX_SAMPLES = 1_000_000
TABLE_SUFFIX = ".dist"
"""Of distribution tables of tc."""
_TABLE_SCALE = 8192
"""What a table of tc counts as 1."""
_SPACES = b" \t\r\n\v\f"
_UNITS_S = {"": 1.0, "s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_DELAY = re.compile(r"([+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)\s*([a-z]*)")


def read_files(settings: LinkSettings, folder: Path, place: str = "") -> LinkSettings:
    """Return settings that name no files: what the files say stands in them.

    Args:
        settings: of one direction of a link.
        folder: where relative names begin.
        place: where the settings stand, for messages, e.g. ``links.toml: link.0.forward``; without
            it only the file is named.

    Raises:
        CallerError: one line; a file cannot be read, or says something else than it should.
    """
    place = _within(place, "impairments")
    return settings.model_copy(
        update={
            "impairments": tuple(
                read_impairment(impairment, folder, _within(place, str(number)))
                for number, impairment in enumerate(settings.impairments)
            )
        }
    )


def read_impairment(impairment: Impairment, folder: Path, place: str = "") -> Impairment:
    """Return an impairment that names no file; see :func:`read_files`."""
    if isinstance(impairment, LossOf):
        return LossOf(loss=read_loss(impairment.loss, folder, _within(place, "loss")))
    if not isinstance(impairment, Delay) or impairment.file is None:
        return impairment
    what = NamedFile(impairment.file, folder, place)
    if Path(impairment.file).suffix == TABLE_SUFFIX:
        if impairment.jitter_s == 0:
            what.wrong("a distribution table is scaled by the jitter, which is 0; give a jitter")
        samples_s = [impairment.jitter_s * entry / _TABLE_SCALE for entry in _table(what)]
    else:
        if impairment.jitter_s != 0:
            what.wrong(
                "observed delays are taken as they are, and have no jitter beside them; "
                f"a distribution table of tc is named *{TABLE_SUFFIX}"
            )
        samples_s = list(_observed_s(what))
    if not 2 <= len(samples_s) <= MAX_SAMPLES:
        what.wrong(f"has {len(samples_s)} delays; 2 to {MAX_SAMPLES} are of use")
    if max(map(abs, samples_s)) > MOST_DELAY_S:
        what.wrong(f"has a delay beyond {MOST_DELAY_S:g} s")
    return impairment.model_copy(
        update={"samples_s": tuple(samples_s), "file": None, "jitter_s": 0.0}
    )


def read_loss(loss: Loss, folder: Path, place: str = "") -> Loss:
    """Return a loss model that names no file; see :func:`read_files`."""
    if not isinstance(loss, TraceLoss):
        return loss
    what = NamedFile(loss.file, folder, place)
    marks = np.frombuffer(what.content().translate(None, _SPACES), np.uint8)
    wrong = np.flatnonzero((marks != ord("0")) & (marks != ord("1")))
    if wrong.size:
        what.wrong(f"has a {chr(marks[wrong[0]])!r}; a trace is of 0 and 1, and white space")
    if not marks.size:
        what.wrong("is empty; a trace has a 1 for each lost datagram and a 0 for each other")
    lost = np.flatnonzero(marks == ord("1"))
    if lost.size > MAX_SCRIPT:
        what.wrong(f"loses {lost.size} datagrams; at most {MAX_SCRIPT} can be")
    return ScriptedLoss(lost=tuple(lost.tolist()), repeat_every=marks.size if loss.repeat else 0)


def _within(place: str, key: str) -> str:
    return f"{place}.{key}" if place else ""


def _lines(what: NamedFile) -> Iterator[tuple[int, str]]:
    """Numbered lines that are neither empty nor comments."""
    text = what.content().decode("utf-8", errors="replace")
    for number, line in enumerate(text.splitlines(), 1):
        if line.strip() and not line.startswith("#"):
            yield number, line.strip()


def _table(what: NamedFile) -> Iterator[int]:
    for number, line in _lines(what):
        for word in line.split():
            if not re.fullmatch("-?[0-9]{1,5}", word):
                what.wrong(f"line {number}: {word[:20]}: expected whole numbers, 8192 for 1")
            yield int(word)


def _observed_s(what: NamedFile) -> Iterator[float]:
    for number, line in _lines(what):
        found = _DELAY.fullmatch(line)
        scale = _UNITS_S.get(found[2]) if found else None
        if found is None or scale is None:
            what.wrong(f"line {number}: {line[:20]}: expected one delay, e.g. 0.0125 or 12.5ms")
        else:
            yield float(found[1]) * scale
