"""``noack-check witness.json [--scenario resolved.toml] [--equations FILE]``: verifies a file of witnesses.

``noack-check DOCUMENT PROOF`` verifies a proof of a document instead: see :mod:`noack_verify`.

Prints PROVED and what was proven, for each statement of the file, or REJECTED and the first inequality
that fails. Exit status: 0 if all are proven, 1 if one is not, 2 for a file that cannot be read or written.

The loop is derived from the scenario, as ``noack check NAME --resolved`` prints it; without it, from the
copy in the witness's file. A copy that differs from the scenario is a rejection. A statement about a plant's
equations is proven only of the equations in the file that --equations names, and prints their digest.
"""

import argparse
import os
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

from noack_check.check import RejectedError
from noack_check.files import UnreadableError, read_json, read_text, read_toml
from noack_check.keys import RefusedError, Table
from noack_check.sentences import growth_sentences, quoted
from noack_verify import verify

_PLANTS = {
    "own": "its plant",
    "box": "all plants of its uncertainty box",
    "region": "the plant with the equations",
}
_CONDITIONS = {"ideal": "ideal conditions", "schedule": "its schedule"}
_LONGEST_NAME, _MOST_KEYS, _SHORT_DIGEST = 200, 5, 12


class _StoreOnce(argparse.Action):
    """The value of an option, which may be given once; argparse's own keeps the last one."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: object,
        option_string: str | None = None,
    ) -> None:
        """Store the value."""
        if option_string is not None and getattr(namespace, self.dest) is not None:
            raise argparse.ArgumentError(self, "is given twice; it takes one value")
        setattr(namespace, self.dest, values)


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(
        "noack-check",
        description="Verify the bounds of a loop: from a loop document and a proof, or from witnesses.",
    )
    parser.add_argument(
        "witness",
        metavar="document|witness",
        type=Path,
        help="a loop document, which needs the proof beside it; or a file of witnesses, by `noack certify "
        "NAME --witness FILE` or `noack margin NAME --witness FILE`",
    )
    parser.add_argument(
        "proof",
        type=Path,
        nargs="?",
        help="the proof of the document's bounds; `noack certify NAME --document DOCUMENT --proof PROOF` "
        "writes both",
    )
    parser.add_argument(
        "--scenario", action=_StoreOnce, type=Path, help="the scenario, by `noack check NAME --resolved`"
    )
    parser.add_argument(
        "--equations",
        action=_StoreOnce,
        type=Path,
        help="the plant's equations, by `noack certify NAME --document D --proof P --equations FILE`: that "
        "the document allows all that they do is verified, too; a witness about equations needs them",
    )
    arguments = parser.parse_args()
    if arguments.proof is not None:
        if arguments.scenario is not None:
            parser.error("a loop document needs no --scenario")
        sys.exit(verify(arguments.witness, arguments.proof, arguments.equations))
    try:
        file = read_json(arguments.witness)
        given = None if arguments.scenario is None else read_toml(arguments.scenario)
        equations = None if arguments.equations is None else read_text(arguments.equations)
    except UnreadableError as error:
        print(printable(f"noack-check: {error}"), file=sys.stderr)
        sys.exit(2)
    try:
        for line in check_file(file, given, equations):
            print(printable(line))
        sys.stdout.flush()
    except (RejectedError, RefusedError) as error:
        print(printable(f"REJECTED {error}"))
        sys.exit(1)
    except OSError as error:  # the output cannot be written
        if not isinstance(error, BrokenPipeError):
            print(f"noack-check: standard output: {error.strerror}", file=sys.stderr)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(2)


def check_file(file: Table, given: Table | None, equations: str | None = None) -> Iterator[str]:
    """Yield a line for each bound that a file of witnesses proves.

    Args:
        file: its content.
        given: the resolved scenario; None: the file's copy is used.
        equations: text with the equations that statements may be about; None: none is.

    Raises:
        RejectedError: a statement is not proven, or the copy differs from the scenario.
        RefusedError: a key of the scenario is not covered.
    """
    if "coordinates" in file:
        raise RejectedError("this is a loop document; its proof is missing: noack-check DOCUMENT PROOF")
    if file.get("format") == "noack-forms 1":
        raise RejectedError("this is a proof; its loop document goes before it: noack-check DOCUMENT PROOF")
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
        of = f"{quoted(name)}, {_PLANTS[plants]}, {_CONDITIONS[conditions]}"
        raise RejectedError(
            "bounds have a document and a proof of their own: `noack certify NAME --document D --proof P`"
        )


def _differences(given: Table, scenario: Table) -> list[str]:
    """Return the keys by which two scenarios differ; the text that describes them is not compared."""
    keys = {*given, *scenario} - {"description"}
    return sorted(key for key in keys if given.get(key) != scenario.get(key))


def printable(text: str) -> str:
    """Return a text as one line; characters that a terminal may act upon are escaped."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


if __name__ == "__main__":
    main()
