"""Search the stored proofs again and write them: ``python -m tests.checker.write_witnesses [NAME ...]``.

A file whose bounds would grow by more than 3 % is left as it is, and the command fails.
"""

import json
import math
import os
import sys
import tempfile
from collections.abc import Mapping

from noack.proof.search.results import Proof
from noack.proof.statement_proof import prove_statement
from tests.checker.proofs import FOLDER, SEARCHES, proved

MOST_GROWTH = 1.03


def sizes(proof: Proof) -> Mapping[tuple[str, bool], float]:
    """Return the least bound of each output at t = 0, and in the limit."""
    found: dict[tuple[str, bool], float] = {}
    for bound in proof.bounds:
        key = bound.output, bound.from_start
        size = math.hypot(float(bound.decaying) * bound.from_start, float(bound.constant))
        found[key] = min(size, found.get(key, math.inf))
    return found


def grown(before: Proof, after: Proof) -> list[str]:
    """Return which bounds grew by more than is allowed, or are missing."""
    larger, new = [], sizes(after)
    for (output, from_start), old in sizes(before).items():
        size = new.get((output, from_start), math.inf)
        if size > MOST_GROWTH * old:
            larger.append(f"{output}{'' if from_start else ' in the limit'}: {old:.6g} -> {size:.6g}")
    return larger


def write(name: str) -> list[str]:
    """Search a proof and write its file; return which bounds grew, if the old file was kept for it."""
    search, path = SEARCHES[name], FOLDER / f"{name}.json"
    document = search.search()
    found = prove_statement(search.loop_of(document), document)
    larger = grown(proved(name).proof, found) if path.exists() else []
    if not larger:
        path.write_text(json.dumps(document, allow_nan=False, separators=(",", ":")) + "\n")
    return larger


def main() -> None:
    """Write the files of some names, or of all."""
    FOLDER.mkdir(exist_ok=True)
    has_grown = False
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_CACHE_HOME"] = folder  # nothing was found before
        for name in sys.argv[1:] or SEARCHES:
            larger = write(name)
            outcome = f"kept, a bound grew: {'; '.join(larger)}" if larger else "written"
            print(f"{name}: {outcome}", flush=True)
            has_grown |= bool(larger)
    for path in () if sys.argv[1:] else FOLDER.glob("*.json"):
        if path.stem not in SEARCHES:
            path.unlink()
    sys.exit(has_grown)


if __name__ == "__main__":
    main()
