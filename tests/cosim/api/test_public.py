"""The interface of ``import noack``: documented, typed, and without heavy imports until used."""

import doctest
import inspect
import json
import pydoc
import re
import subprocess
import sys
from pathlib import Path

import pytest

import noack

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs/library.md").read_text()
HEAVY = ("cosim", "matplotlib", "numpy", "pyarrow", "pydantic", "rerun", "scipy", "zenoh")


def loaded_by(program: str) -> set[str]:
    code = f"{program}\nimport json, sys\nprint(json.dumps([*sys.modules]))"
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(json.loads(process.stdout.splitlines()[-1]))


def documented(heading: str) -> set[str]:
    """Names in the first column of the table below a heading."""
    text = PAGE.partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    rows = [line.split("|")[1] for line in text.splitlines() if line.startswith("| `")]
    return {re.match(r"[\w.]+", name)[0] for row in rows for name in re.findall("`(.+?)`", row)}  # type: ignore[index]


def members(kind: type) -> set[str]:
    own = {name for name in vars(kind) if not name.startswith("_")}
    return own | {name for name in kind.__annotations__ if not name.startswith("_")}


def test_the_public_names_are_the_documented_ones() -> None:
    assert {name.removeprefix("noack.") for name in documented("Names")} == set(noack.__all__)


def test_the_members_of_results_are_the_documented_ones() -> None:
    assert documented("Campaigns") == members(noack.CampaignResult)
    assert documented("Runs") == members(noack.Run)
    assert documented("Exact runs") == members(noack.ExactRun)
    assert documented("Certificates") == members(noack.Certificates)


@pytest.mark.parametrize("name", sorted(set(noack.__all__) - {"__version__"}))
def test_every_public_name_has_a_docstring(name: str) -> None:
    public = getattr(noack, name)
    text = inspect.getdoc(public)
    assert text
    assert f"{name} in module noack" in pydoc.render_doc(public, renderer=pydoc.plaintext)
    if inspect.isfunction(public):
        parameters = inspect.signature(public).parameters
        assert not parameters or {"Args:", "Raises:"} <= set(text.split())
        for parameter in parameters:
            assert f"    {parameter}: " in text, parameter
    if public in (noack.CampaignResult, noack.Run, noack.ExactRun, noack.Certificates):
        for member in vars(public).values():
            target = member.fget if isinstance(member, property) else member
            if inspect.isfunction(target) and not target.__name__.startswith("_"):
                assert inspect.getdoc(target)
                assert inspect.signature(target).return_annotation is not inspect.Signature.empty


@pytest.mark.parametrize(("program", "heavy"), [
    ("import noack; dir(noack)", HEAVY),
    ("import noack; noack.load('lane_following')", ("matplotlib", "rerun", "scipy.stats", "zenoh")),
    ("import controller_node.__main__, plant_server.__main__", ("cosim",)),
])  # fmt: skip
def test_a_program_loads_no_modules_that_it_does_not_need(program: str, heavy: tuple[str]) -> None:
    assert not loaded_by(program) & set(heavy)


def test_an_unknown_name_is_refused_with_a_message() -> None:
    with pytest.raises(AttributeError, match="module 'noack' has no attribute 'simulates'"):
        noack.simulates  # type: ignore[attr-defined]  # noqa: B018
    assert set(noack.__all__) <= set(dir(noack))


WITHOUT_EXAMPLE = {"__version__", "ExportedRun", "follow"}
"""What an export is given, and what needs a run of another program."""
LIVE = {"run"}  # tests/integration/test_documented_runs.py
EXAMPLES = sorted({*noack.__all__, *noack._NOT_IN_STAR} - WITHOUT_EXAMPLE - LIVE)


@pytest.mark.system
@pytest.mark.parametrize("name", EXAMPLES)
def test_the_examples_of_the_docstrings_run(name: str) -> None:
    (example,) = doctest.DocTestFinder(recurse=False).find(getattr(noack, name), name, module=False, globs={})
    outcome = doctest.DocTestRunner().run(example)
    assert outcome.attempted > 1
    assert outcome.failed == 0
