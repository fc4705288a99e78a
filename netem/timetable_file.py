"""The file of a timetable: a CSV file with a line for each change of settings.

    time_s,words
    0,delay 20ms
    10,loss burst 30% 5 delay 80ms 20ms
    12.5,"blackout 0s-3600s"

Its header names the columns: ``time_s`` (seconds since the start), ``words`` (as of ``noack netem
set``: they replace all settings of the direction), and if needed ``direction`` (forward, reverse or
both; forward where it is missing) and ``link``. All mistakes of a file are reported together.
"""

import csv
import difflib
import re
from collections.abc import Iterator, Sequence
from decimal import Decimal
from pathlib import Path
from typing import NamedTuple, cast

from netem.core.clock import NS_PER_S
from netem.core.errors import CallerError, printable, shortened
from netem.core.named_file import NamedFile
from netem.core.number_format import counted
from netem.impairments.link_settings import LinkSettings
from netem.impairments.target_loss import read_files
from netem.link_state import LinkState
from netem.relay.relay_links import LinkSpec
from netem.relay.relay_reports import DIRECTIONS, Direction
from netem.relay.timetable import TimedChange, Timetable
from netem.tc_words import guarantee_words, settings_of

MOST_CHANGES = 100_000
SHORTEST_NS = NS_PER_S // 1000
"""Shortest time after which a timetable repeats."""
_COLUMNS = ("time_s", "words", "direction", "link")
_REQUIRED = _COLUMNS[:2]
_NUMBER = re.compile(r"[0-9]+\.?[0-9]*|\.[0-9]+")
_LATEST_S = 10**9
_MOST_MISTAKES = 10
"""Mistakes that are reported of one file."""


class TimetableLine(NamedTuple):
    """A line of the file."""

    number: int
    changes: Sequence[TimedChange]
    """One, or one for each direction."""
    words: str
    """As the file has them."""


class TimetableFile(NamedTuple):
    """The content of a file."""

    path: Path
    lines: Sequence[TimetableLine]
    repeat_ns: int | None

    @property
    def summary(self) -> str:
        """The number of changes, and their times."""
        count, last = len(self.timetable.changes), self.timetable.changes[-1]
        text = f"{counted(count, 'change')} of settings, the last at {last.at_ns / NS_PER_S:g} s"
        return text if self.repeat_ns is None else f"{text}, repeated every {self.repeat_ns / NS_PER_S:g} s"

    @property
    def timetable(self) -> Timetable:
        """The changes, for a relay."""
        return Timetable(tuple(change for line in self.lines for change in line.changes), self.repeat_ns)

    def notes(self, specs: Sequence[LinkSpec]) -> Iterator[str]:
        """Yield which lines end a guarantee that applied before: words replace all settings."""
        applied = {(spec.name, side): getattr(spec, side) for spec in specs for side in DIRECTIONS}
        for line in self.lines:
            for change in line.changes:
                before = guarantee_words(applied[change.link, change.direction])
                if before and not guarantee_words(change.settings):
                    yield (
                        f"{self.path}: line {line.number}: {change.direction} no longer has "
                        f"{', '.join(before)}; the words replace all settings"
                    )
                applied[change.link, change.direction] = change.settings


def read_timetable(path: Path, specs: Sequence[LinkSpec], repeat_ns: int | None = None) -> TimetableFile:
    """Read a timetable for the links of a relay.

    Args:
        path: the file; the files that its words name are in its folder.
        specs: the links.
        repeat_ns: the time after which it repeats.

    Raises:
        CallerError: one line for each mistake, with file, line, value and remedy.
    """
    return _Reader(path, specs, repeat_ns).read()


class _Reader:
    def __init__(self, path: Path, specs: Sequence[LinkSpec], repeat_ns: int | None) -> None:
        self._path, self._repeat_ns = path, repeat_ns
        self._links = {spec.name: spec for spec in specs}
        self._settings: dict[tuple[str, Direction], LinkSettings] = {}
        """Of the words that have been read: many lines may have the same."""
        self._last: tuple[int, str, int] = 0, "0", 0
        """Time of the line before, as a number and as text, and the number of this line."""
        self._changed: dict[tuple[str, Direction], tuple[int, int]] = {}
        """Of each direction of a link: time and line of its last change."""

    def read(self) -> TimetableFile:
        mistakes, lines = list[str](), list[TimetableLine]()
        header: list[str] | None = None
        for number, text in NamedFile(str(self._path), Path()).lines():
            try:
                cells = _cells(text)
                if header is None:
                    self._check_header(cells)
                    header = cells
                else:
                    lines.append(self._line(number, header, cells))
            except CallerError as error:
                mistakes.append(f"{self._path}: line {number}: {error}")
                if header is None:
                    break
            if len(lines) + len(mistakes) > MOST_CHANGES:
                mistakes.append(f"{self._path}: has more than {MOST_CHANGES} changes")
                break
        if not lines and not mistakes:
            content = "nothing" if header is None else "a header only"
            mistakes.append(
                f"{self._path}: has {content}; expected lines such as time_s,words and 10,loss 5%"
            )
        if len(mistakes) > _MOST_MISTAKES:
            mistakes[_MOST_MISTAKES:] = [f"{self._path}: {len(mistakes) - _MOST_MISTAKES} more mistakes"]
        if mistakes:
            raise CallerError("\n".join(mistakes))
        return TimetableFile(self._path, lines, self._repeat_ns)

    def _check_header(self, header: Sequence[str]) -> None:
        example = "time_s,words" if len(self._links) == 1 else "time_s,link,words"
        for name in header:
            if name not in _COLUMNS:
                close = difflib.get_close_matches(name, _COLUMNS, 1)
                hint = f"did you mean {close[0]}?" if close else f"the columns are {', '.join(_COLUMNS)}"
                raise CallerError(f"{_excerpt(name)}: no such column; {hint}")
            if header.count(name) > 1:
                raise CallerError(f"has the column {name} twice")
        needed = _REQUIRED if len(self._links) == 1 else (*_REQUIRED, "link")
        if missing := [name for name in needed if name not in header]:
            raise CallerError(f"has no column {missing[0]}; the first line is a header, e.g. {example}")

    def _line(self, number: int, header: Sequence[str], cells: Sequence[str]) -> TimetableLine:
        if len(cells) != len(header):
            quotes = "; words with a comma stand in quotation marks" if len(cells) > len(header) else ""
            raise CallerError(
                f"has {counted(len(cells), 'column')}, and the header {len(header)}: "
                f"{','.join(header)}{quotes}"
            )
        row = dict(zip(header, cells, strict=True))
        at_ns = self._time_ns(number, row["time_s"])
        link = self._link(row.get("link", ""))
        changes = []
        for direction in self._directions(row.get("direction", ""), self._links[link]):
            before_ns, line = self._changed.get((link, direction), (-1, 0))
            if before_ns == at_ns:
                raise CallerError(
                    f"line {line} sets {direction} at {row['time_s']} s, too; each direction has one "
                    "line at a time"
                )
            self._changed[link, direction] = at_ns, number
            changes.append(TimedChange(at_ns, link, direction, self._settings_of(row["words"], direction)))
        return TimetableLine(number, changes, row["words"])

    def _time_ns(self, number: int, text: str) -> int:
        if not _NUMBER.fullmatch(text) or Decimal(text) > _LATEST_S:
            raise CallerError(f"time_s is {_excerpt(text)}; expected seconds since the start, e.g. 2.5")
        at_ns = round(Decimal(text) * NS_PER_S)
        before_ns, before, line = self._last
        if at_ns < before_ns:
            raise CallerError(f"time_s is {text}, before {before} in line {line}; the times must not descend")
        self._last = at_ns, text, number
        if self._repeat_ns is not None and at_ns >= self._repeat_ns:
            raise CallerError(
                f"time_s is {text}, but the timetable repeats every {self._repeat_ns / NS_PER_S:g} s; "
                "repeat it later, or leave the line out"
            )
        return at_ns

    def _link(self, name: str) -> str:
        if not name and len(self._links) == 1:
            return next(iter(self._links))
        if name not in self._links:
            raise CallerError(f"link is {_excerpt(name)}; the links are {', '.join(self._links)}")
        return name

    def _directions(self, name: str, spec: LinkSpec) -> Sequence[Direction]:
        if name not in ("", *DIRECTIONS, "both"):
            raise CallerError(f"direction is {_excerpt(name)}; expected forward, reverse or both")
        if name in ("reverse", "both") and not spec.return_path:
            raise CallerError(f"direction is {name}; link {spec.name} relays forward only")
        return DIRECTIONS if name == "both" else (cast(Direction, name or "forward"),)

    def _settings_of(self, words: str, direction: Direction) -> LinkSettings:
        if not words:
            raise CallerError("words are missing, e.g. loss 5% mansd 4; or loss none")
        if (words, direction) not in self._settings:
            folder = self._path.parent
            settings = read_files(settings_of(words, direction=direction, folder=folder), folder)
            try:
                LinkState(settings, 0)  # the core accepts its numbers
            except ValueError as error:
                raise CallerError(f"{shortened(words)}: {error}") from None
            self._settings[words, direction] = settings
        return self._settings[words, direction]


def _cells(line: str) -> list[str]:
    try:
        row = next(csv.reader([line.lstrip("\ufeff")], skipinitialspace=True, strict=True))
    except csv.Error:
        raise CallerError(f"{_excerpt(line)}: a quotation is not closed, or goes on behind its end") from None
    return [cell.strip() for cell in row]


def _excerpt(text: str) -> str:
    return repr(printable(shortened(text, 40)))
