"""A second verifier, of bounds by gains: for loops of which no quadratic forms are known.

It verifies that a proof proves bounds of a document of a loop, both being files, and imports nothing of
noack or of the other verifiers. ``docs/proof-format.md`` describes both formats and the argument.
"""

from noack_gains.apart import share_of_threshold
from noack_gains.document import Document
from noack_gains.gains import Gains
from noack_gains.reading import RejectedError
from noack_gains.statement import Proven, Statement, prove, read_proof
from noack_gains.words import in_words

__all__ = [
    "Document",
    "Gains",
    "Proven",
    "RejectedError",
    "Statement",
    "in_words",
    "prove",
    "read_proof",
    "share_of_threshold",
]
