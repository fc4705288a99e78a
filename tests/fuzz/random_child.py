"""One parser with random inputs: ``python -m tests.fuzz.random_child NAME CORPUS UNTIL FLAGS…``.

It stands in for the coverage-guided fuzzer beside ASan, whose symbols that fuzzer's coverage uses.
If an input ends the process, it is in the file ``crash-input``.
"""

import random
import sys
import time
from pathlib import Path

from tests.fuzz.harness import parsers

name, corpus, until, *flags = sys.argv[1:]
(prefix,) = (flag.partition("=")[2] for flag in flags if flag.startswith("-artifact_prefix="))
under_test, finding = parsers()[name], Path(f"{prefix}crash-input")
waiting = [path.read_bytes() for path in sorted(Path(corpus).iterdir())]
end_s, count = time.monotonic() + int(until.partition("=")[2]), 0
chosen = random.Random(time.time_ns())
while waiting or time.monotonic() < end_s:
    data = waiting.pop() if waiting else chosen.randbytes(chosen.randrange(400))
    finding.write_bytes(data)
    under_test.run(data)
    count += 1
finding.unlink()
print(f"#{count} DONE cov: 0 ft: 0")
