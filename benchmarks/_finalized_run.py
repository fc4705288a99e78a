"""Finalises a run directory, and prints the CPU time of each phase: ``_finalized_run RUN_DIR``.

The phases are those of this process, in s as a JSON object; the replay of a long run takes place in
another process beside them, whose CPU time is a phase, too.
"""

import functools
import json
import resource
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from cosim.analysis.claims.claim_evaluation import RunClaims
from cosim.live import finalize
from cosim.output.viewer import run_recording

REPLAY = "replay"
_PHASES = (
    ("spool and Parquet", finalize, "finish_record"),
    ("recording", run_recording, "write_view"),
    ("summary", finalize, "summarise"),
    ("fidelity", finalize, "fidelity_for_summary"),
    ("conditions", RunClaims, "violations"),
    ("claims", RunClaims, "judge"),
    ("report", finalize, "_write_report"),
)


def main(run_dir: str) -> None:
    """Finalise a run."""
    took_s: Counter[str] = Counter()
    for phase, owner, name in _PHASES:
        setattr(owner, name, _timed(getattr(owner, name), phase, took_s))
    finalize.reopen(Path(run_dir))
    child = resource.getrusage(resource.RUSAGE_CHILDREN)
    took_s[REPLAY] = child.ru_utime + child.ru_stime
    print(json.dumps(took_s))


def _timed(function: Callable[..., Any], phase: str, took_s: Counter[str]) -> Callable[..., Any]:
    @functools.wraps(function)
    def timed(*arguments: Any, **options: Any) -> Any:
        begun_s = time.process_time()
        try:
            return function(*arguments, **options)
        finally:
            took_s[phase] += time.process_time() - begun_s

    return timed


if __name__ == "__main__":
    main(*sys.argv[1:])
