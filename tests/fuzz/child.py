"""One parser under the coverage-guided fuzzer: ``python -m tests.fuzz.child NAME FLAGS…``.

The fuzzer ends at the first input that makes the parser fail, and keeps it.
"""

import sys
from types import ModuleType

PACKAGES = ("noack", "netem", "cosim", "tests", "tomllib", "shlex")
"""Packages with coverage instrumentation."""


def main(atheris: ModuleType) -> None:
    """Fuzz until the limit in the fuzzer's flags."""
    name, *flags = sys.argv[1:]
    with atheris.instrument_imports(include=list(PACKAGES)):
        from tests.fuzz.harness import harness

        under_test = harness(name)
    atheris.Setup([sys.argv[0], *flags], under_test.run)
    atheris.Fuzz()


if __name__ == "__main__":
    import atheris

    main(atheris)
