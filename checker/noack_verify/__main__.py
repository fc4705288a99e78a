"""``noack-check DOCUMENT PROOF [--equations FILE]``: verifies a proof of a document.

Exit status: 0 if all is proven, 1 if something is not, 2 for a file that cannot be read or written.
"""

import argparse
import sys
from pathlib import Path

from noack_verify.command import verify


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
    parser = argparse.ArgumentParser("noack-check", description="Verify the proof of a loop document.")
    parser.add_argument(
        "document", type=Path, help="the document, by `noack certify NAME --document DOCUMENT --proof PROOF`"
    )
    parser.add_argument("proof", type=Path, help="the proof, which the same command writes")
    parser.add_argument(
        "--equations",
        action=_StoreOnce,
        type=Path,
        help="the plant's equations, by `noack certify NAME --document D --proof P --equations FILE`: that "
        "the document allows all that they do is verified, too",
    )
    arguments = parser.parse_args()
    sys.exit(verify(arguments.document, arguments.proof, arguments.equations))


if __name__ == "__main__":
    main()
