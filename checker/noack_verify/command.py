"""Verifies a proof of a document, both being files, and prints what is proven.

Prints PROVED and each bound, or REJECTED and what is not proven. Exit status: 0 if all bounds are proven,
1 if one is not, 2 for a file that cannot be read or written.
"""

import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from noack_equations import RejectedError as RejectedEquationsError
from noack_equations import claimed_digest, lines_of_equations, prove_equations
from noack_gains import Document, RejectedError, prove
from noack_gains.document import FORMAT as OF_GAINS
from noack_gains.statement import lines_of_gains
from noack_gains.words import conditions
from noack_kernel.__main__ import FAILED, UNREADABLE, printable, read_file
from noack_kernel.__main__ import verify as verify_by_kernel


def verify(document: Path, proof: Path, equations: Path | None = None) -> int:
    """Print what a proof proves of a document, both being files, and return the exit status.

    Args:
        document: the document.
        proof: of its bounds.
        equations: of the plant; then the document has to allow all that they do, too.
    """
    try:
        texts = read_file(document), read_file(proof)
        of_plant = None if equations is None else read_file(equations)
    except OSError as error:
        print(f"noack-check: {printable(str(error.filename))}: {error.strerror}", file=sys.stderr)
        return UNREADABLE
    except ValueError as error:
        print(printable(f"noack-check: {error}"), file=sys.stderr)
        return UNREADABLE
    if format_of(texts[0]) != OF_GAINS and (status := verify_by_kernel(document, proof)):
        return status
    try:
        lines = by_gains(*texts) if format_of(texts[0]) == OF_GAINS else iter(())
        for line in (*lines, *of_equations(texts[0], of_plant)):
            print(printable(line))
        print(end="", flush=True)
    except (RejectedError, RejectedEquationsError) as error:
        print(printable(f"REJECTED {error}"))
        return FAILED
    except OSError as error:  # the output cannot be written
        if not isinstance(error, BrokenPipeError):
            print(f"noack-check: standard output: {error.strerror}", file=sys.stderr)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return UNREADABLE
    return 0


def by_gains(document: str, proof: str) -> Iterator[str]:
    """Yield the lines about what a proof by gains proves; both are the contents of files.

    Raises:
        RejectedError: it proves nothing.
    """
    proven, loop = prove(document, proof), Document(document)
    for sentence in proven.sentences():
        yield f"PROVED {sentence}"
    yield f"       for each run of the loop {loop.name!r}"
    yield f"       with the SHA-256 {loop.digest}"
    yield from (f"       where {line.strip()}" for line in conditions(loop))
    yield f"       by small gains, which {lines_of_gains()} lines of Python verified: another program"
    yield "       than the one for loop documents"


def of_equations(document: str, equations: str | None) -> Iterator[str]:
    """Yield the lines about a plant's equations; both are the contents of files.

    Raises:
        RejectedEquationsError: the document does not allow what the equations do.
    """
    if equations is not None:
        proven = prove_equations(document, equations)
        yield f"PROVED {proven}"
        yield f"       by an enclosure of the equations, which {lines_of_equations()} further lines verified"
    elif (digest := claimed_digest(document)) is not None:
        yield "       This is about the document only. It claims to allow all that the equations with the"
        yield f"       SHA-256 {digest} do: --equations FILE verifies this."


def format_of(text: str) -> str:
    """Return the format that a document names; empty if it names none."""
    try:
        table = json.loads(text)
    except (ValueError, RecursionError):
        return ""
    return str(table.get("format")) if isinstance(table, dict) else ""
