"""The kernel: verifies that a proof proves the bounds of a loop document, both being files.

It imports nothing of noack. ``docs/proof-format.md`` describes both formats and all rules.
"""

from noack_kernel.exact import RejectedError
from noack_kernel.statement import GrowthStatement, Proven, Statement, prove

__all__ = ["GrowthStatement", "Proven", "RejectedError", "Statement", "prove"]
