"""``noack-check DOCUMENT PROOF``: verifies a proof of the bounds of a loop document.

Prints PROVED and each bound, or REJECTED and what is not proven. Exit status: 0 if all bounds are proven,
1 if one is not, 2 for a file that cannot be read or written.
"""

import argparse
import os
import stat
import sys
from pathlib import Path

from noack_kernel.document import MOST_BYTES, Document
from noack_kernel.exact import RejectedError
from noack_kernel.statement import lines_of_kernel, prove

FAILED, UNREADABLE = 1, 2


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser("noack-check", description="Verify a proof of the bounds of a loop.")
    parser.add_argument("document", type=Path, help="loop document, by `noack certify NAME --document FILE`")
    parser.add_argument("proof", type=Path, help="proof of its bounds, by `noack certify NAME --proof FILE`")
    arguments = parser.parse_args()
    sys.exit(verify(arguments.document, arguments.proof))


def verify(document: Path, proof: Path) -> int:
    """Print what a proof proves of a document, both being files, and return the exit status."""
    try:
        texts = read_file(document), read_file(proof)
    except OSError as error:
        print(f"noack-check: {printable(str(error.filename))}: {error.strerror}", file=sys.stderr)
        return UNREADABLE
    except ValueError as error:
        print(printable(f"noack-check: {error}"), file=sys.stderr)
        return UNREADABLE
    try:
        proven, loop = prove(*texts), Document(texts[0])
        for sentence in proven.sentences:
            print(printable(f"PROVED {sentence}"))
        print(printable(f"       for each run of the loop document {loop.name!r}"))
        print(f"       with the SHA-256 {loop.digest}")
        for fact, words in loop.words.items():
            print(printable(f"       in which a fact is {fact!r}: {words}"))
        lines = lines_of_kernel()
        print(f"       by {proven.inequalities} inequalities, which {lines} lines of Python verified")
        print(end="", flush=True)
    except RejectedError as error:
        print(printable(f"REJECTED {error}"))
        return FAILED
    except OSError as error:  # the output cannot be written
        if not isinstance(error, BrokenPipeError):
            print(f"noack-check: standard output: {error.strerror}", file=sys.stderr)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return UNREADABLE
    return 0


def read_file(path: Path) -> str:
    """Return the text of a regular file.

    Raises:
        OSError: it cannot be read.
        ValueError: it is no regular file, too large, or no text.
    """
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise ValueError(f"{path}: not a regular file")
        with os.fdopen(descriptor, "rb", closefd=False) as file:
            content = file.read(MOST_BYTES + 1)
    finally:
        os.close(descriptor)
    if len(content) > MOST_BYTES:
        raise ValueError(f"{path}: larger than {MOST_BYTES // 2**20} MiB")
    try:
        return content.decode()
    except UnicodeDecodeError:
        raise ValueError(f"{path}: not a text file") from None


def printable(text: str) -> str:
    """Return a text as one line; characters that a terminal may act upon are escaped."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


if __name__ == "__main__":
    main()
