"""The same bits: whichever compiler has built the core, and on whichever processor libraries run."""

import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import pytest

from native.build import LIBRARIES
from tests.native import sanitized_core

pytestmark = [pytest.mark.system]
ROOT = sanitized_core.ROOT
MODULE = "tests.native.digests"


def run(command: Sequence[str | Path], **environment: str) -> list[str]:
    done = subprocess.run(
        command, env=os.environ | environment, cwd=ROOT, capture_output=True, text=True,
        check=False, timeout=500,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-1000:] + done.stderr[-3000:]
    return done.stdout.splitlines()


@cache
def own_digests() -> list[str]:
    digests = run([sys.executable, "-m", MODULE])
    assert len(digests) > 300
    return digests


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
def test_runs_have_the_same_bits_on_processors_whose_libraries_differ(processor: dict[str, str]) -> None:
    """The settings have an effect on x86-64 only. Others' matrices and users' classes come from scipy."""
    linear = run([sys.executable, "-m", MODULE, "linear"], **processor)
    assert len(linear) > 70
    assert set(linear) <= set(own_digests())


def test_runs_have_the_same_bits_with_sanitizers_and_little_optimisation() -> None:
    command: Sequence[str]
    environment: Mapping[str, str]
    try:
        command, environment = sanitized_core.command(MODULE)
    except sanitized_core.NoSanitizersError as error:
        pytest.skip(str(error))
    assert run(command, **environment) == own_digests()


@pytest.mark.skipif(find_spec("ziglang") is None, reason="the package ziglang is not installed")
def test_runs_have_the_same_bits_if_ziglang_builds_the_core(tmp_path: Path) -> None:
    for name in LIBRARIES:
        build = [sys.executable, ROOT / "native" / "build.py", name, "--into", tmp_path / name]
        run(build, CC="", PATH=str(tmp_path))  # as on a machine that has no compiler
    other = ["tests.native.sanitized_core", str(tmp_path), MODULE]
    assert run([sys.executable, "-m", *other]) == own_digests()
