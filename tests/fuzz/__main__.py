"""``python -m tests.fuzz run|show``: run the long run; show one input as a corpus line."""

import argparse
import importlib.util
import os
import sys
from pathlib import Path

from tests.fuzz.harness import NAMES, harness, to_line
from tests.fuzz.long import fuzz_all


def main() -> int:
    """Return 0, or 1 if a parser fails."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    commands = parser.add_subparsers(required=True, dest="command")
    run = commands.add_parser("run", help="fuzz; exit status 1 if something was found")
    run.add_argument("--minutes", type=float, default=10.0, help="of wall time, for all (10)")
    run.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="parsers at a time")
    run.add_argument("names", nargs="*", metavar="PARSER", help=f"of {', '.join(NAMES)}")
    show = commands.add_parser("show", help="run one input again")
    show.add_argument("name", choices=NAMES)
    show.add_argument("file", type=Path)
    options = parser.parse_args()
    if options.command == "show":
        data = options.file.read_bytes()
        print(to_line(data))
        harness(options.name).run(data)
        print("nothing is wrong with this")
        return 0
    names = options.names or NAMES
    if wrong := set(names) - set(NAMES):
        parser.error(f"no such parser: {', '.join(sorted(wrong))}; there are {', '.join(NAMES)}")
    if importlib.util.find_spec("atheris") is None:
        print("the fuzzer, atheris, is not installed; it has wheels for Linux and few Pythons")
        return 2
    return 1 if fuzz_all(names, options.minutes, options.jobs) else 0


if __name__ == "__main__":
    sys.exit(main())
