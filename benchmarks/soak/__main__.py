"""``python -m benchmarks.soak [hour] [day] [--minutes M] [--json FILE] [--runs DIR]``."""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from benchmarks._report import MeasurementError
from benchmarks.soak.run import print_result, soak
from noack.config.scenario_file import load
from noack.core.errors import NoackError

KINDS = ("hour", "day")
_TABLE_WIDTH = 130
_LEAST_MINUTES = 0.2


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the soak; return 0 if all memory was flat and no claim was violated."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.soak",
        description="Run the loop for an hour at speed 1, then for a day of simulated time in half "
        "an hour, and watch it: memory, descriptors and threads must stay flat, every claim must "
        "hold.",
    )
    add = parser.add_argument
    add("kinds", nargs="*", metavar="KIND", choices=[[], *KINDS], help=f"of {', '.join(KINDS)}")
    add("--minutes", type=_minutes, metavar="M", help="a shorter one; of the first kind only")
    add("--json", type=Path, metavar="FILE", help="write all figures to FILE")
    add("--runs", type=Path, default=Path("runs"), help="where runs are kept")
    add("--set", action="append", default=[], metavar="KEY=VALUE", help="replace a value")
    options = parser.parse_args(arguments)
    console = Console()
    if not console.is_terminal:
        console.width = _TABLE_WIDTH
    results, status = [], 0
    for kind in options.kinds or (KINDS if options.minutes is None else KINDS[:1]):
        path = Path(__file__).parent / f"{kind}.toml"
        settings = list(options.set)
        try:
            if options.minutes is not None:
                speed = load(path, settings).speed
                settings.append(f"horizon_s={60 * options.minutes * speed!r}")
            result = soak(path, tuple(settings), options.runs, _say)
        except (MeasurementError, NoackError) as error:
            print(f"soak: {error}", file=sys.stderr)
            return 2
        print_result(console, result)
        results.append(result.as_json())
        status |= bool(result.faults)
    if options.json is not None:
        options.json.write_text(json.dumps(results, indent=2, default=float) + "\n")
    return status


def _minutes(text: str) -> float:
    minutes = float(text)
    if not _LEAST_MINUTES <= minutes <= 1e4:
        raise argparse.ArgumentTypeError(f"must be a number of at least {_LEAST_MINUTES}")
    return minutes


def _say(text: str) -> None:
    print(f"  {text}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
