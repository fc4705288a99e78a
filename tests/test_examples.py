"""Run each example program unchanged, in its own folder."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "docs/examples"
FIGURES = {
    "own_plant": {"own_plant.svg", "own_plant_errors.svg"},
    "model_or_hold": {"model_or_hold.svg"},
}


def test_every_example_has_a_test() -> None:
    assert {path.stem for path in EXAMPLES.iterdir()} == FIGURES.keys()


@pytest.mark.parametrize("name", FIGURES)
def test_an_example_runs_and_leaves_its_figures(name: str, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, EXAMPLES / f"{name}.py"],
        cwd=tmp_path, env=os.environ | {"MPLBACKEND": "Agg"},
        capture_output=True, text=True, check=False, timeout=250,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    assert done.stdout
    assert {path.name for path in tmp_path.iterdir()} == FIGURES[name]


@pytest.mark.parametrize("name", FIGURES)
def test_an_example_is_in_the_percent_format(name: str) -> None:
    """The percent format: prose and code cells alternate, and the page begins with its title."""
    first, *cells = (EXAMPLES / f"{name}.py").read_text().split("\n# %%")
    assert first.startswith("# %% [markdown]\n# # ")
    for cell in cells:
        kind, _, body = cell.partition("\n")
        prose = [line.startswith("#") for line in body.strip().splitlines()]
        assert all(prose) if kind == " [markdown]" else (kind == "" and not any(prose))
