"""Linear loops compute the same on processors of which the libraries compute differently."""

import os
import subprocess
import sys

import pytest

_PRINT_DIGESTS = """
import hashlib
from cosim.simulation.virtual_time import simulate
from tests.shipped import resolved
for name in ("lane_following", "f16_lateral", "unstable_pendulum"):
    record = simulate(resolved(name, "horizon_s=2"))
    for table in sorted(record.tables):
        rows = record[table]
        for column in rows.dtype.names:
            print(name, table, column, hashlib.sha256(rows[column].tobytes()).hexdigest())
"""


@pytest.mark.parametrize(
    "processor",
    [
        {"OPENBLAS_CORETYPE": "Prescott"},
        {
            "NPY_DISABLE_CPU_FEATURES": "AVX2 FMA3 AVX512F",
            "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4",
        },
    ],
    ids=["BLAS", "numpy and C"],
)
def test_runs_have_the_same_bits(processor: dict[str, str]) -> None:
    """The settings have an effect on x86-64 only."""
    own, other = _digests({}), _digests(processor)
    assert len(own) > 50
    assert other == own


def _digests(settings: dict[str, str]) -> list[str]:
    environment = {key: value for key, value in os.environ.items() if key != "OPENBLAS_CORETYPE"}
    found = subprocess.run(
        [sys.executable, "-c", _PRINT_DIGESTS], env=environment | settings, check=True,
        capture_output=True, text=True,
    )  # fmt: skip
    return found.stdout.splitlines()
