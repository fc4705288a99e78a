"""``python -m tests.fuzz.scenarios``: check random whole scenarios; exit status 1 on a contradiction.

Draw i of a seed is the same everywhere: ``--seed 3 --only 17`` repeats one.
"""

import os

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # before numpy is imported
os.environ["NOACK_NO_EXTENSIONS"] = "1"

import argparse
import contextlib
import multiprocessing
import re
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import count, islice
from pathlib import Path

from tests.fuzz.scenarios.check_draw import LIMIT_S, TOO_LONG, Checked, Contradiction, check_draw
from tests.fuzz.scenarios.draws import NEVER_DRAWN, draw, schema_keys

_MOST_SHOWN = 12
"""Reasons of refusals that are listed."""
_EVERY_S = 10.0
"""Time between two lines of progress."""
_WITNESSES_EVERY = 5
"""Each of so many draws is searched for witnesses, unless all are."""


class Totals:
    """What became of all draws so far."""

    def __init__(self) -> None:
        self.draws = self.refused = 0
        self.counts, self.refusals = Counter[str](), Counter[str]()
        self.keys = set[str]()
        self.contradictory = set[int]()

    def add(self, checked: Checked, folder: Path) -> None:
        """Count a draw; print its contradictions, and write its files into a folder."""
        self.draws += 1
        self.counts += checked.counts
        self.keys |= checked.keys
        self.refused += checked.is_refused
        self.refusals.update(map(_without_numbers, checked.refusals.elements()))
        for name in checked.counts:
            if name.endswith(TOO_LONG):
                print(f"draw {checked.number} of seed {checked.seed}: {name}", flush=True)
        if not checked.contradictions:
            return
        self.contradictory.add(checked.number)
        path = draw(checked.seed, checked.number).write(folder / f"{checked.seed}-{checked.number}")
        for contradiction in checked.contradictions:
            of_draw = f"draw {checked.number} of seed {checked.seed} ({path})"
            print(f"{of_draw}: {contradiction.step}: {contradiction.what}")
            for line in contradiction.detail.splitlines():
                print(f"    {line}")
        sys.stdout.flush()

    def print_summary(self, elapsed_s: float) -> None:
        """Print the numbers, the refusals by reason, and the keys that no accepted draw had."""
        print(f"{self.draws} draws in {elapsed_s:.0f} s, {self.refused} refused, "
              f"{len(self.contradictory)} with a contradiction")  # fmt: skip
        for name, number in sorted(self.counts.items()):
            print(f"  {name}: {number}")
        print("refused, by step and reason:")
        for reason, number in self.refusals.most_common(_MOST_SHOWN):
            print(f"  {number} x {reason}")
        missing = sorted(schema_keys() - self.keys - NEVER_DRAWN.keys())
        print(f"keys that no accepted draw had: {', '.join(missing) or 'only those that are never drawn'}")


def _without_numbers(line: str) -> str:
    """Return a message without what differs from draw to draw."""
    return re.sub(r"-?[0-9][0-9.e-]*", "#", line)[:130]


def checked_draws(
    seed: int, numbers: Iterator[int], processes: int, limit_s: float, *, theory: bool, witnesses: bool
) -> Iterator[Checked]:
    """Check draws in some processes; yield the results as they come.

    Witnesses are searched for each fifth draw, or for all. If a process dies, the draws that were
    under way are contradictions, and the search ends.
    """
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, context, max_tasks_per_child=200) as pool:
        pending: dict[Future[Checked], int] = {}
        while True:
            for number in islice(numbers, processes + 1 - len(pending)):
                searched = witnesses or number % _WITNESSES_EVERY == 0
                future = pool.submit(check_draw, seed, number, limit_s, theory=theory, witnesses=searched)
                pending[future] = number
            if not pending:
                return
            done, _ = wait(pending, return_when=FIRST_COMPLETED)
            if any(isinstance(future.exception(), BrokenProcessPool) for future in done):
                yield from (_died(seed, number) for number in pending.values())
                return
            for future in done:
                del pending[future]
                yield future.result()


def _died(seed: int, number: int) -> Checked:
    what = "a process died during this draw, or another one that has this message"
    return Checked(
        seed, number, False, [Contradiction(seed, number, "all", what)], set(), Counter(), Counter()
    )


def _numbers(options: argparse.Namespace) -> Iterator[int]:
    if options.only:
        yield from options.only
        return
    end = time.monotonic() + 60 * options.minutes if options.minutes else None
    for number in islice(count(options.first), None if end else options.number):
        if end is not None and time.monotonic() > end:
            return
        yield number


def main(arguments: Sequence[str] | None = None) -> int:
    """Check random scenarios; return 1 if there is a contradiction."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--number", type=int, default=200, help="number of draws")
    parser.add_argument("--minutes", type=float, help="instead: draw for this time")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of the first draw")
    parser.add_argument("--only", type=int, nargs="+", help="check these draws")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--limit", type=float, default=LIMIT_S, help="largest CPU time of a step, in s")
    parser.add_argument(
        "--failures", type=Path, default=Path("fuzz-failures"), help="folder for failing draws"
    )
    parser.add_argument("--runs-only", action="store_true", help="no claims, certificates and adversary")
    parser.add_argument(
        "--witnesses", action="store_true", help="search for witnesses of all draws, not of each fifth only"
    )
    options = parser.parse_args(arguments)
    totals, began_s = Totals(), time.monotonic()
    said_s = began_s
    processes = min(options.processes, len(options.only)) if options.only else options.processes
    numbers, theory = _numbers(options), not options.runs_only
    with contextlib.suppress(KeyboardInterrupt):  # the results so far are shown
        for checked in checked_draws(
            options.seed, numbers, processes, options.limit, theory=theory, witnesses=options.witnesses
        ):
            totals.add(checked, options.failures)
            if time.monotonic() - said_s > _EVERY_S:
                said_s = time.monotonic()
                print(f"{totals.draws} draws, {len(totals.contradictory)} with a contradiction, "
                      f"{said_s - began_s:.0f} s", file=sys.stderr)  # fmt: skip
    totals.print_summary(time.monotonic() - began_s)
    return 1 if totals.contradictory else 0


if __name__ == "__main__":
    sys.exit(main())
