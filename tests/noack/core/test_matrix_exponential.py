"""The matrix exponential against scipy's, closed forms, and itself on other processors."""

import os
import subprocess
import sys

import numpy as np
import pytest
from scipy.linalg import expm

from noack.core.linear_systems import exponential

SIZES = (1, 2, 5, 14)
_PRINT_BITS = """
import numpy as np
from noack.core.linear_systems import exponential
draw = np.random.default_rng(3)
for n in (1, 2, 4, 9, 16):
    for scale in (1e-6, 0.1, 1.0, 30.0):
        print(exponential(scale * draw.normal(size=(n, n))).tobytes().hex())
"""
OTHER_PROCESSORS = [
    {"OPENBLAS_CORETYPE": "Prescott"},
    {"OPENBLAS_CORETYPE": "Haswell"},
    {"NPY_DISABLE_CPU_FEATURES": "AVX2 FMA3 AVX512F"},
    {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4"},
]
"""Make numpy, its BLAS and the C library compute as on an older processor, if this is an x86."""


@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize("scale", [0.0, 1e-9, 0.3, 0.95, 4.0, 60.0])
def test_it_is_that_of_scipy(n: int, scale: float) -> None:
    matrix = scale * np.random.default_rng(n).uniform(-1, 1, (n, n)) / np.sqrt(n)
    expected = expm(matrix)
    error = np.linalg.norm(exponential(matrix) - expected)
    assert error <= 1e-13 * max(scale, 1) * np.linalg.norm(expected)


def test_nilpotent_and_stiff_matrices_are_exact() -> None:
    shift = np.array([[0.0, 1e6], [0.0, 0.0]])
    assert exponential(shift) == pytest.approx(np.eye(2) + shift, rel=1e-15)
    stiff = exponential(np.diag([-500.0, -1e-3]))
    assert np.diag(stiff) == pytest.approx(np.exp([-500.0, -1e-3]), rel=1e-13)


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e5])
def test_a_large_input_matrix_costs_no_accuracy(size: float) -> None:
    """[[a, b], [0, 0]] has the exponential [[e^a, b (e^a - 1)/a], [0, 1]]."""
    a, b = -0.25, size
    found = exponential(np.array([[a, b], [0.0, 0.0]]))
    assert found[0, 0] == pytest.approx(np.exp(a), rel=1e-15)
    assert found[0, 1] == pytest.approx(b * np.expm1(a) / a, rel=1e-15)
    assert found[1].tolist() == [0.0, 1.0]


def test_sums_of_commuting_matrices_multiply() -> None:
    """e^(sM) e^(tM) = e^((s + t)M), and e^M e^(−M) is the identity."""
    draw = np.random.default_rng(8)
    for n in (2, 3, 6):
        M = draw.normal(size=(n, n))
        both = exponential(0.3 * M) @ exponential(1.1 * M)
        assert both == pytest.approx(exponential(1.4 * M), rel=1e-12, abs=1e-12)
        assert exponential(M) @ exponential(-M) == pytest.approx(np.eye(n), abs=1e-12)


@pytest.mark.parametrize("entry", [800.0, 1e300, np.inf, np.nan])
def test_what_overflows_is_not_finite_and_ends(entry: float) -> None:
    assert not np.isfinite(exponential(np.array([[entry, 1.0], [0.0, 1.0]]))).all()


def test_every_processor_gives_the_same_bits() -> None:
    own = _bits({})
    for settings in OTHER_PROCESSORS:
        assert _bits(settings) == own, settings


def _bits(settings: dict[str, str]) -> str:
    environment = {key: value for key, value in os.environ.items() if key != "OPENBLAS_CORETYPE"}
    found = subprocess.run(
        [sys.executable, "-c", _PRINT_BITS], env=environment | settings, check=True,
        capture_output=True, text=True,
    )  # fmt: skip
    return found.stdout
