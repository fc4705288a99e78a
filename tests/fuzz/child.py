"""One parser under the coverage-guided fuzzer: ``python -m tests.fuzz.child NAME FLAGS…``.

The fuzzer ends at the first input that makes the parser fail, and keeps it.
"""

import sys

import atheris

with atheris.instrument_imports(include=["noack", "netem", "cosim", "tests", "tomllib", "shlex"]):
    from tests.fuzz.harness import parsers

    under_test = parsers()[sys.argv[1]]
atheris.Setup([sys.argv[0], *sys.argv[2:]], under_test.run)
atheris.Fuzz()
