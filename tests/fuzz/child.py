"""One parser under the coverage-guided fuzzer: ``python -m tests.fuzz.child NAME OUT FLAGS…``.

For each failure, the smallest input that causes it is kept, and the fuzzer continues. Fuzzing stops
only if the process ends: a crash or hang of compiled code, or too much memory.
"""

import hashlib
import sys
import traceback
from pathlib import Path
from types import ModuleType

PACKAGES = ("noack", "netem", "cosim", "tests", "tomllib", "shlex")
"""Packages with coverage instrumentation."""


class Findings:
    """Failures, one for each place in the code.

    Args:
        folder: the folder for the inputs and their tracebacks.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._smallest: dict[str, int] = {}

    def add(self, data: bytes, error: BaseException) -> None:
        """Keep an input unless a smaller one causes the same failure."""
        place = signature(error)
        if len(data) >= self._smallest.get(place, 2**63):
            return
        self._smallest[place] = len(data)
        path = self._folder / f"finding-{hashlib.sha256(place.encode()).hexdigest()[:12]}"
        path.write_bytes(data)
        text = "".join(traceback.format_exception(error))
        path.with_suffix(".txt").write_text(text, encoding="utf-8", errors="backslashreplace")


def signature(error: BaseException) -> str:
    """Return the place of a failure: the exception's type and the innermost project frames."""
    frames = [
        f"{frame.filename}:{frame.lineno}"
        for frame in traceback.extract_tb(error.__traceback__)
        if any(f"/{package}/" in frame.filename for package in PACKAGES[:4])
        and "site-packages" not in frame.filename
    ]
    return " ".join([type(error).__name__, *frames[-2:]])


def main(atheris: ModuleType) -> None:
    """Fuzz until the limit in the fuzzer's flags."""
    name, out, *flags = sys.argv[1:]
    with atheris.instrument_imports(include=list(PACKAGES)):
        from tests.fuzz.harness import harness

        under_test = harness(name)
    findings = Findings(Path(out))

    def target(data: bytes) -> None:
        try:
            under_test.run(data)
        except Exception as error:
            findings.add(data, error)

    atheris.Setup([sys.argv[0], *flags], target)
    atheris.Fuzz()


if __name__ == "__main__":
    import atheris

    main(atheris)
