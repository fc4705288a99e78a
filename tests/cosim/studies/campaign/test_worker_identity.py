"""Workers repeat the arithmetic of a run's processes exactly: on one BLAS thread."""

import os
import subprocess
import sys

COMPUTE = """
import hashlib
import numpy as np
from noack.core.linear_systems import transition
generator = np.random.default_rng(1).normal(size=(66, 66))
print(hashlib.sha256(transition(generator, 2_000_000).tobytes()).hexdigest())
"""


def computed(script: str, threads: str) -> str:
    environment = os.environ | {"OPENBLAS_NUM_THREADS": threads}
    return subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
    ).stdout


def test_large_matrices_are_rounded_as_in_the_processes_of_a_run() -> None:
    """The exponential of a 66 x 66 matrix has different last bits on several threads."""
    assert computed(f"import cosim.cli\n{COMPUTE}", "4") == computed(COMPUTE, "1")
