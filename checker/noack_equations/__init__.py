"""A trusted program beside the kernel: a plant's equations do only what a document allows.

It reads a document's claim about equations, encloses the equations on the region of the document's limits,
and compares. ``docs/proof-format.md`` has the claim's format and the rules E1 to E4.
"""

from noack_equations.claims import Proven, claimed_digest, lines_of_equations, prove_equations
from noack_equations.enclosure import (
    SIGNALS,
    Along,
    Enclosed,
    Evaluation,
    LinearPlants,
    Region,
    RejectedError,
    UndefinedError,
    enclose,
    region_of,
)

__all__ = [
    "SIGNALS",
    "Along",
    "Enclosed",
    "Evaluation",
    "LinearPlants",
    "Proven",
    "Region",
    "RejectedError",
    "UndefinedError",
    "claimed_digest",
    "enclose",
    "lines_of_equations",
    "prove_equations",
    "region_of",
]
