"""The text of a plant's equations: a line for each step and each rate, read as steps of :mod:`.enclosure`.

    s_5 = sin(x_1)
    s_7 = s_5 · 9.81
    s_2 > 0
    dx_1/dt = x_2

A number is the double that is nearest to it, as in the program that has the equations. A line ``s_2 > 0`` or
``s_2 ≥ 0`` states which case of a comparison holds; it is verified on the whole region.
"""

import hashlib
import math
import re
from collections.abc import Mapping, Sequence

from noack_equations.enclosure import FUNCTIONS, MOST_STEPS, SHAPES, RejectedError

MOST_BYTES = 2**20
_NUMBER = re.compile(r"-?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?")
_VARIABLE = re.compile(r"([xu])_([1-9]\d{0,3})")
_ASSIGNED = re.compile(r"(s_[1-9]\d{0,5}|dx_[1-9]\d{0,3}/dt) = (.+)")
_CASE = re.compile(r"(\S+) ([>≥]) 0")
_CALL = re.compile(r"([a-z]+)\((.*)\)")
_INFIX = {" + ": "add", " · ": "times"}
_BY_NAME = {"sqrt": "root"}
Step = list[str | int | float | None]


def digest_of(block: str) -> str:
    """Return the SHA-256 of equations: lines without spaces at their ends, each with a line feed."""
    return hashlib.sha256(("\n".join(_lines(block)) + "\n").encode()).hexdigest()


def block_of(text: str, digest: str) -> str:
    """Return the equations with a digest, of a file that has some, with empty lines between them.

    Raises:
        RejectedError: the file has none with this digest.
    """
    if len(text) > MOST_BYTES:
        raise RejectedError("equations: the file is larger than 1 MiB")
    for block in re.split(r"\n[ \t]*\n", text.replace("\r\n", "\n")):
        if digest_of(block) == digest:
            return block
    raise RejectedError(f"the document is about equations with the SHA-256 {digest}, and the file has others")


def steps_of(block: str) -> Mapping[str, object]:
    """Return the steps and rates of equations, as :func:`.enclosure.enclose` reads them.

    Raises:
        RejectedError: a line has no meaning.
    """
    reader = _Reader()
    for line in _lines(block):
        reader.read(line)
    count = len(reader.rates)
    if sorted(reader.rates) != [*range(count)]:
        raise RejectedError("equations: the rates are not dx_1/dt, dx_2/dt, ..., each once")
    return {"steps": reader.steps, "rates": [reader.rates[i] for i in range(count)]}


def _lines(block: str) -> list[str]:
    return [line.rstrip() for line in block.splitlines() if line.strip()]


class _Reader:
    def __init__(self) -> None:
        self.steps: list[Step] = []
        self.rates: dict[int, int] = {}
        self._names: dict[str, int] = {}
        self._known: dict[tuple[object, ...], int] = {}

    def read(self, line: str) -> None:
        """Read a line."""
        if (case := _CASE.fullmatch(line)) is not None:
            self._add(["positive" if case[2] == ">" else "nonnegative", self._operand(case[1])])
            return
        assigned = _ASSIGNED.fullmatch(line)
        if assigned is None:
            raise RejectedError(f"equations: {line[:60]!r} is neither a step, a rate nor a case")
        name, index = assigned[1], self._formula(assigned[2])
        if name.startswith("dx_"):
            place = int(name.removeprefix("dx_").removesuffix("/dt")) - 1
            if place in self.rates:
                raise RejectedError(f"equations: {name} occurs twice")
            self.rates[place] = index
        elif name in self._names:
            raise RejectedError(f"equations: {name} occurs twice")
        else:
            self._names[name] = index

    def _formula(self, text: str) -> int:
        for joint, name in _INFIX.items():
            if joint in text:
                first, second = text.split(joint, 1)
                return self._add([name, self._operand(first), self._operand(second)])
        if text.startswith("−"):
            return self._add(["negative", self._operand(text.removeprefix("−"))])
        if (call := _CALL.fullmatch(text)) is not None:
            return self._call(_BY_NAME.get(call[1], call[1]), call[2].split(", "))
        return self._operand(text)

    def _call(self, name: str, given: Sequence[str]) -> int:
        shape = (1, 0) if name in FUNCTIONS else SHAPES.get(name)
        is_call = shape is not None and shape[0] == 1 and name not in ("negative", "positive", "nonnegative")
        if shape is None or not is_call or len(given) != sum(shape):
            raise RejectedError(f"equations: {name[:40]!r} is no function of such a form")
        numbers = [None if each == "None" else _number(each) for each in given[1:]]
        return self._add([name, self._operand(given[0]), *numbers])

    def _operand(self, text: str) -> int:
        """Return the index of a step that has a name, a state, an input, the time or a number."""
        if text in self._names:
            return self._names[text]
        if text == "t":
            return self._add(["time"])
        if (variable := _VARIABLE.fullmatch(text)) is not None:
            return self._add(["state" if variable[1] == "x" else "input", int(variable[2]) - 1])
        return self._add(["number", _number(text)])

    def _add(self, step: Step) -> int:
        key = tuple(step)
        if key not in self._known:
            if len(self.steps) >= MOST_STEPS:
                raise RejectedError(f"equations: more than {MOST_STEPS} steps")
            self.steps.append(step)
            self._known[key] = len(self.steps) - 1
        return self._known[key]


def _number(text: str) -> float:
    if _NUMBER.fullmatch(text) is None or not math.isfinite(value := float(text)):
        raise RejectedError(f"equations: {text[:40]!r} is no number, and no step before it")
    return value
