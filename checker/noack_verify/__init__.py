"""The command ``noack-check DOCUMENT PROOF``: which verifier reads the files, and what is printed.

A document names its format: ``noack-hybrid 1`` is one for :mod:`noack_kernel`, ``noack-gains-loop 1`` one for
:mod:`noack_gains`, the verifier of bounds by gains.
"""

from noack_verify.command import verify

__all__ = ["verify"]
