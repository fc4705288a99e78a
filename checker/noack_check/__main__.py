"""``noack-check witness.json [--scenario resolved.toml]``: verifies a file of witnesses.

Prints PROVED and what was proven, for each statement of the file, or REJECTED and the first inequality
that fails. Exit status: 0 if all are proven, 1 if one is not, 2 for a file that cannot be read or written.

The loop is derived from the scenario, as ``noack check NAME --resolved`` prints it; without it, from the
copy in the witness's file. A copy that differs from the scenario is a rejection.
"""

import argparse
import json
import os
import sys
import tomllib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from noack_check.check import RejectedError
from noack_check.growth import prove_growth, read_periodic_loop
from noack_check.keys import RefusedError, Table
from noack_check.proof import prove
from noack_check.scenario import output_names, read_enclosed, read_loop
from noack_check.sentences import assumptions, equations_text, growth_sentences, meaning, sentences

_PLANTS = {"own": "its plant", "box": "all plants of its uncertainty box", "region": "its plant's equations"}
_CONDITIONS = {"ideal": "ideal conditions", "schedule": "its schedule"}
_LONGEST_NAME, _MOST_KEYS = 200, 5
MOST_BYTES = 64 * 1024**2


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser("noack-check", description="Verify the witnesses of bounds of a loop.")
    parser.add_argument(
        "witness",
        type=Path,
        help="file that `noack certify NAME --witness FILE` or `noack margin` with --witness has written",
    )
    parser.add_argument("--scenario", type=Path, help="the scenario, by `noack check NAME --resolved`")
    arguments = parser.parse_args()
    try:
        file = _read(arguments.witness, "JSON", json.loads)
        given = None if arguments.scenario is None else _read(arguments.scenario, "TOML", tomllib.loads)
    except UnreadableError as error:
        print(f"noack-check: {error}", file=sys.stderr)
        sys.exit(2)
    try:
        for line in check_file(file, given):
            print(line)
        sys.stdout.flush()
    except (RejectedError, RefusedError) as error:
        print(f"REJECTED {error}")
        sys.exit(1)
    except OSError as error:  # the output cannot be written
        if not isinstance(error, BrokenPipeError):
            print(f"noack-check: standard output: {error.strerror}", file=sys.stderr)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(2)


def check_file(file: Table, given: Table | None) -> Iterator[str]:
    """Yield a line for each bound that a file of witnesses proves.

    Args:
        file: its content.
        given: the resolved scenario; None: the file's copy is used.

    Raises:
        RejectedError: a statement is not proven, or the copy differs from the scenario.
        RefusedError: a key of the scenario is not covered.
    """
    scenario, statements = file.get("scenario"), file.get("statements")
    if given == {}:
        raise RejectedError("--scenario: the file has no key")
    if not isinstance(scenario, Mapping) or not isinstance(statements, list) or not statements:
        raise RejectedError("the file has no scenario, or no statements")
    if given is not None and (different := _differences(given, scenario)):
        raise RejectedError(
            f"the witness is of another scenario, by its {', '.join(different[:_MOST_KEYS])}; "
            "--scenario takes what `noack check NAME --resolved` prints"
        )
    scenario = scenario if given is None else given
    name = scenario.get("name")
    if not isinstance(name, str) or not name.isprintable() or len(name) > _LONGEST_NAME:
        raise RejectedError("name: not a printable name of a scenario")
    for document in statements:
        if not isinstance(document, Mapping):
            raise RejectedError("a statement is no table")
        plants, conditions = document.get("plants"), document.get("conditions")
        if not isinstance(plants, str) or not isinstance(conditions, str):
            raise RejectedError("a statement has no plants or conditions")
        if plants not in _PLANTS or conditions not in _CONDITIONS:
            raise RejectedError("a statement has no plants or conditions")
        if document.get("statement") == "growth" and (plants, conditions) != ("own", "schedule"):
            raise RejectedError("growth: is of the plant itself under its schedule")
        of = f"{name}, {_PLANTS[plants]}, {_CONDITIONS[conditions]}"
        if document.get("statement") == "growth":
            growth = prove_growth(read_periodic_loop(scenario), document)
            yield from (f"PROVED {of}, nothing late: {sentence}" for sentence in growth_sentences(growth))
            continue
        enclosed = read_enclosed(scenario, document) if plants == "region" else None
        loop = read_loop(scenario, box=plants == "box", ideal=conditions == "ideal", enclosed=enclosed)
        for sentence in sentences(prove(loop, document), output_names(scenario)):
            yield f"PROVED {of}: {sentence}"
        if meant := meaning(scenario, loop):
            yield f"       where {meant}"
        yield f"       if there are {assumptions(scenario, loop)}"
        if enclosed is not None:
            yield f"       and the plant is {equations_text(document)}"


def _differences(given: Table, scenario: Table) -> list[str]:
    """Return the keys by which two scenarios differ; the text that describes them is not compared."""
    keys = {*given, *scenario} - {"description"}
    return sorted(key for key in keys if given.get(key) != scenario.get(key))


class UnreadableError(ValueError):
    """A file cannot be read; the message names it."""


def _read(path: Path, kind: str, parse: Callable[[str], object]) -> Table:
    """Return the table in a file of a kind, which ``parse`` reads.

    Raises:
        UnreadableError: there is none.
    """
    try:
        with path.open("rb") as file:
            content = file.read(MOST_BYTES + 1)
    except OSError as error:
        raise UnreadableError(f"{path}: {error.strerror}") from None
    if len(content) > MOST_BYTES:
        raise UnreadableError(f"{path}: larger than {MOST_BYTES // 1024**2} MiB")
    try:
        found = parse(content.decode())
    except (ValueError, RecursionError):
        raise UnreadableError(f"{path}: not a {kind} file") from None
    if not isinstance(found, dict):
        raise UnreadableError(f"{path}: not a table")
    return found


if __name__ == "__main__":
    main()
