"""Reading a file strictly: exact numbers, no key twice, no unknown key, sizes with limits."""

import json
import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from flint import arb, arb_mat, fmpq, fmpq_mat

MOST_BYTES = 16 * 2**20
MOST_DIGITS = 400
"""Most characters of a number, and largest exponent of a decimal."""
MOST_ENTRIES = 100_000
"""Of a matrix."""
MOST_TEXT = 2000
_DECIMAL = re.compile(r"(-?)([0-9]+)(?:\.([0-9]+))?(?:[eE]([+-]?[0-9]+))?")
_QUOTIENT = re.compile(r"(-?[0-9]+)/([0-9]+)")
Table = Mapping[str, object]


class RejectedError(ValueError):
    """The document is malformed, or the proof does not prove its bounds; the message says where."""


class Matrix(NamedTuple):
    """All matrices whose entries are within ``radius`` of ``mid``, both exact. The radius None is 0."""

    mid: fmpq_mat
    radius: fmpq_mat | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """The numbers of rows and columns."""
        return int(self.mid.nrows()), int(self.mid.ncols())

    @property
    def balls(self) -> arb_mat:
        """Balls that contain the matrices."""
        found = arb_mat(*self.shape, [arb(entry) for entry in self.mid.entries()])
        if self.radius is not None:
            for index, size in enumerate(self.radius.entries()):
                if size != 0:
                    place = divmod(index, self.shape[1])
                    found[place] = found[place] + arb(0, arb(size).upper())
        return found

    @property
    def is_zero(self) -> bool:
        """Whether all entries are exactly 0."""
        return all(M is None or all(entry == 0 for entry in M.entries()) for M in self)

    def zero_rows(self) -> list[bool]:
        """Return for each row whether all its entries are exactly 0."""
        height, width = self.shape
        every = [(M, i, j) for M in self if M is not None for i in range(height) for j in range(width)]
        moved = {i for M, i, j in every if M[i, j] != 0}
        return [i not in moved for i in range(height)]


def decimal(text: str) -> fmpq:
    """Return the exact value of a decimal such as ``-2.5e-3``."""
    match = _DECIMAL.fullmatch(text)
    if match is None or len(text) > MOST_DIGITS or abs(power := int(match[4] or 0)) > MOST_DIGITS:
        raise RejectedError(f"not a number, or too long: {text[:40]}")
    digits, places = int(match[2] + (match[3] or "")), len(match[3] or "")
    value = fmpq(digits, 10**places) * (fmpq(10**power) if power >= 0 else fmpq(1, 10**-power))
    return -value if match[1] else value


def rational(value: object, place: str) -> fmpq:
    """Return an exact number of a file: a decimal, as :func:`decimal` has read it, or a string "p/q"."""
    if isinstance(value, fmpq):
        return value
    match = _QUOTIENT.fullmatch(value) if isinstance(value, str) and len(value) <= 2 * MOST_DIGITS else None
    if match is None or int(match[2]) == 0:
        raise RejectedError(f"{place[:80]}: not a number: {str(value)[:40]!r}")
    return fmpq(int(match[1]), int(match[2]))


def size(value: object, place: str) -> fmpq:
    """Return a number of a file that is at least 0."""
    if (found := rational(value, place)) < 0:
        raise RejectedError(f"{place[:80]}: below 0")
    return found


def whole(value: object, place: str, most: int) -> int:
    """Return a whole number of a file, from 0 to ``most``."""
    found = rational(value, place)
    if found.q != 1 or not 0 <= found <= most:
        raise RejectedError(f"{place[:80]}: not a whole number from 0 to {most}")
    return int(found.p)


def truth(value: object, place: str) -> bool:
    """Return true or false of a file."""
    if not isinstance(value, bool):
        raise RejectedError(f"{place[:80]}: neither true nor false")
    return value


def read_matrix(rows: object, place: str, height: int | None, width: int) -> Matrix:
    """Return a matrix of a file; an entry is a number, or an interval [low, high].

    Args:
        rows: as the file has them.
        place: names the matrix in messages.
        height: the number of rows; None: any.
        width: the number of columns.
    """
    if not isinstance(rows, list) or (height is not None and len(rows) != height):
        raise RejectedError(f"{place[:80]}: not {'' if height is None else height} rows")
    if len(rows) * width > MOST_ENTRIES or any(
        not isinstance(row, list) or len(row) != width for row in rows
    ):
        raise RejectedError(f"{place[:80]}: a row has not {width} entries, or there are too many")
    mid, radius = fmpq_mat(len(rows), width), None
    for i, row in enumerate(rows):
        for j, entry in enumerate(row):
            if not isinstance(entry, list):
                mid[i, j] = rational(entry, place)
                continue
            ends = [rational(end, place) for end in entry]
            if len(ends) != 2 or not ends[0] <= ends[1]:
                raise RejectedError(f"{place[:80]}: an interval has not two ends in their order")
            radius = fmpq_mat(len(rows), width) if radius is None else radius
            mid[i, j], radius[i, j] = (ends[0] + ends[1]) / 2, (ends[1] - ends[0]) / 2
    return Matrix(mid, radius)


def exact_matrix(rows: object, place: str, height: int | None, width: int) -> Matrix:
    """Return a matrix of a file without intervals."""
    found = read_matrix(rows, place, height, width)
    if found.radius is not None:
        raise RejectedError(f"{place[:80]}: an interval, where numbers are exact")
    return found


def read_table(text: str, expected: str, what: str) -> Table:
    """Return the table in a JSON text: exact numbers, no key twice, of the expected format.

    Args:
        text: the content of the file.
        expected: the format.
        what: the file is, for messages: the document, or the proof.

    Raises:
        RejectedError: it is none.
    """
    if len(text) > MOST_BYTES:
        raise RejectedError(f"the {what} is larger than {MOST_BYTES // 2**20} MiB")
    try:
        table = json.loads(
            text,
            parse_float=decimal,
            parse_int=decimal,
            parse_constant=lambda name: decimal(str(name)),
            object_pairs_hook=_once,
        )
    except RecursionError:
        raise RejectedError(f"the {what} is nested too deeply") from None
    except json.JSONDecodeError as error:
        raise RejectedError(f"the {what} is not JSON: {error}") from None
    except RejectedError as error:
        raise RejectedError(f"the {what}: {error}") from None
    found = table.get("format") if isinstance(table, dict) else None
    if found != expected:
        other = f", but one of {found[:40]!r}" if isinstance(found, str) else ""
        raise RejectedError(
            f'the {what} is not a file of the format "{expected}"{other}; '
            "the order is: noack-check DOCUMENT PROOF"
        )
    return dict(table)


def _once(pairs: Sequence[tuple[str, object]]) -> dict[str, object]:
    table = dict[str, object]()
    for key, value in pairs:
        if key in table:
            raise RejectedError(f"the key {key[:40]!r} occurs twice")
        table[key] = value
    return table


def fields(table: Table, place: str, required: Sequence[str], optional: Sequence[str] = ()) -> None:
    """Require a table's keys to be those that it must have, and perhaps those that it may have."""
    if missing := sorted({*required} - {*table}):
        raise RejectedError(f"{place[:80]}: {missing[0]} is missing")
    if unknown := sorted({*table} - {*required} - {*optional}):
        raise RejectedError(f"{place[:80]}: unknown key {unknown[0][:40]!r}")


def mapping(value: object, place: str) -> Table:
    """Return a table."""
    if not isinstance(value, dict):
        raise RejectedError(f"{place[:80]}: not a table")
    return value


def entries(value: object, place: str) -> list[Table]:
    """Return a list of tables."""
    if not isinstance(value, list):
        raise RejectedError(f"{place[:80]}: not a list")
    return [mapping(each, place) for each in value]


def text_of(value: object, place: str, most: int = 200) -> str:
    """Return a printable text, perhaps empty."""
    if not isinstance(value, str) or not value.isprintable() or len(value) > most:
        raise RejectedError(f"{place[:80]}: not a printable text of at most {most} characters")
    return value


def names_of(values: Sequence[object], place: str) -> list[str]:
    """Return names, which are not empty, each once."""
    found = [text_of(value, place) for value in values]
    if not all(found) or len({*found}) < len(found):
        raise RejectedError(f"{place[:80]}: a name is empty or occurs twice")
    return found
