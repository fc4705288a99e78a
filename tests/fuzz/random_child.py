"""One parser with random inputs: ``python -m tests.fuzz.random_child NAME CORPUS UNTIL FLAGS…``.

It stands in for the coverage-guided fuzzer beside ASan, whose symbols that fuzzer's coverage uses,
and takes the same flags as far as they concern it.
"""

import random
import sys
import time
from pathlib import Path

from tests.fuzz.harness import harness

_PREFIX = "-artifact_prefix="
_MOST_BYTES = 400


def main() -> None:
    """Run inputs until the limit. If one ends the process, it is in the file ``crash-input``."""
    name, corpus, until, *flags = sys.argv[1:]
    limit = int(until.removeprefix("-max_total_time="))
    (prefix,) = (flag.removeprefix(_PREFIX) for flag in flags if flag.startswith(_PREFIX))
    under_test, finding = harness(name), Path(f"{prefix}crash-input")
    waiting = [path.read_bytes() for path in sorted(Path(corpus).iterdir())]
    chosen, begin, count = random.Random(time.time_ns()), time.monotonic(), 0
    while waiting or time.monotonic() < begin + limit:
        data = waiting.pop() if waiting else chosen.randbytes(chosen.randrange(_MOST_BYTES))
        finding.write_bytes(data)
        under_test.run(data)
        count += 1
    finding.unlink()
    print(f"#{count} DONE cov: 0 ft: 0")


if __name__ == "__main__":
    main()
