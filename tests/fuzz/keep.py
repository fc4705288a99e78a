"""What is kept of what fuzzing learned: few and short inputs that reach every line reached."""

import sys
from types import CodeType, FrameType
from typing import Any

from tests.fuzz.harness import CORPUS, FOLDER, Harness, harness, kept, to_line
from tests.fuzz.long import OUT

_LONGEST = 400
"""Longer inputs are not kept; seeds stand in files of their own."""
_ROOT = str(FOLDER.parents[1])

Line = tuple[CodeType, int]


def keep(name: str) -> int:
    """Add to a parser's kept inputs; return how many there are then."""
    under_test = harness(name)
    path = CORPUS / f"{name}.txt"
    lines = path.read_text(encoding="ascii").splitlines() if path.is_file() else []
    reached: set[Line] = set()
    for data in [*under_test.seeds, *kept(name)]:
        reached |= lines_of(under_test, data)
    learned = sorted(
        (one.read_bytes() for one in (OUT / name / "corpus").glob("*")), key=lambda d: (len(d), d)
    )
    for data in learned:
        if len(data) <= _LONGEST and (new := lines_of(under_test, data) - reached):
            reached |= new
            lines.append(to_line(data))
    path.write_text("\n".join(lines) + "\n", encoding="ascii")
    return sum(not line.startswith("#") for line in lines)


def lines_of(under_test: Harness, data: bytes) -> set[Line]:
    """The lines of our own code that an input reaches; none if something is wrong with it."""
    reached: set[Line] = set()

    def local(frame: FrameType, event: str, _: Any) -> Any:
        if event == "line":
            reached.add((frame.f_code, frame.f_lineno))
        return local

    def trace(frame: FrameType, event: str, _: Any) -> Any:
        file = frame.f_code.co_filename
        return local if file.startswith(_ROOT) and "/." not in file else None

    sys.settrace(trace)
    try:
        under_test.run(data)
    except Exception:
        return set()
    finally:
        sys.settrace(None)
    return reached
