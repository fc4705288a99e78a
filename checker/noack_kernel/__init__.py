"""The kernel: verifies that a proof proves the bounds of a loop document, both being files.

It imports nothing of noack. ``docs/proof-format.md`` describes both formats and the rules R0 to R7.
"""

from noack_kernel.exact import RejectedError
from noack_kernel.statement import Statement, prove

__all__ = ["RejectedError", "Statement", "prove"]
