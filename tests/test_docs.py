"""The documentation is run: its commands, its snippets, its tables of keys."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel

from noack.records import tables
from noack.scenario import Bernoulli, GilbertElliott, Scenario
from noack.scenario_file import json_schema, load

ROOT = Path(__file__).parents[1]
PAGES = ("README.md", "docs/record.md", "docs/scenarios.md", "docs/paper.md")


def blocks(page: str, language: str) -> list[str]:
    text = (ROOT / page).read_text()
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def commands() -> Iterator[str]:
    for page in PAGES:
        for block in blocks(page, "sh"):
            yield from (line.partition("#")[0].strip() for line in block.splitlines())


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that looks like the repository to a command, with a short run in it."""
    folder = tmp_path_factory.mktemp("docs")
    (folder / "scenarios").symlink_to(ROOT / "scenarios")
    (folder / ".venv" / "bin").mkdir(parents=True)
    noack = folder / ".venv" / "bin" / "noack"
    noack.write_text(f'#!/bin/sh\nexec {sys.executable} -m cosim.cli "$@"\n')
    noack.chmod(0o755)
    result = subprocess.run(
        [noack, "run", "lane_following", "--json", "--set", "ports={}", "--set", "horizon_s=2"],
        cwd=folder, capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    return folder


@pytest.mark.parametrize("command", sorted(set(commands())))
def test_every_command_works(command: str, run_folder: Path) -> None:
    words = shlex.split(command)
    if words[0] == "make":
        # The targets themselves are what surrounds this test; here only that they exist.
        done = subprocess.run(
            ["make", "--dry-run", *words[1:]], cwd=ROOT, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        return
    program = run_folder / ".venv" / "bin" / "noack"
    environment = os.environ | {"PATH": f"{program.parent}:{os.environ['PATH']}"}
    with subprocess.Popen(
        words, cwd=run_folder, env=environment,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        if "netem" in words:
            assert process.stderr is not None
            assert "Ctrl-C ends" in process.stderr.readline()
            process.send_signal(signal.SIGINT)
        stdout, stderr = process.communicate(timeout=60)
    assert process.returncode == 0, stderr
    if "--json" in words:
        json.loads(stdout)


@pytest.mark.parametrize("snippet", blocks("docs/record.md", "python"))
def test_every_snippet_runs(snippet: str, run_folder: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", snippet], cwd=run_folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()


def keys_of(section: type[BaseModel], prefix: str = "") -> Iterator[str]:
    for key, field in section.model_fields.items():
        kind = field.annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            yield from keys_of(kind, f"{prefix}{key}.")
        else:
            yield prefix + key


def test_every_scenario_key_is_documented_and_no_other() -> None:
    text = (ROOT / "docs/scenarios.md").read_text()
    rows = [line.split("|")[1] for line in text.splitlines() if line.startswith("| `")]
    documented: set[str] = set()
    for row in rows:
        names = re.findall(r"`([^`]+)`", row)
        section = names[0].partition(".")[0]
        documented |= {name if not name.startswith(".") else section + name for name in names}
    known = set(keys_of(Scenario))
    assert documented == known
    for loss in (Bernoulli, GilbertElliott):
        for key in loss.model_fields:
            assert f"{key} = " in text


def test_every_column_of_the_record_is_documented() -> None:
    text = (ROOT / "docs/record.md").read_text()
    for table, dtype in tables(1, 1).items():
        (row,) = [line for line in text.splitlines() if line.startswith(f"| `{table}`")]
        for name in dtype.names or ():
            common = name in ("input", "sequence", "t_ns", "now_ns")
            assert common or f"`{name}`" in row, f"{table}.{name}"


def test_every_key_of_the_summary_is_documented(run_folder: Path) -> None:
    summary: dict[str, Any] = json.loads((run_folder / "runs/latest/summary.json").read_text())
    text = (ROOT / "docs/record.md").read_text()
    documented = set(re.findall(r"`([a-z_]+)`", text.partition("## The summary")[2]))
    assert summary.keys() <= documented, summary.keys() - documented


def test_the_exported_schema_is_the_codes() -> None:
    assert json.loads((ROOT / "docs/scenario.schema.json").read_text()) == json_schema()


@pytest.mark.parametrize("path", sorted((ROOT / "scenarios").glob("*.toml")), ids=lambda p: p.stem)
def test_shipped_scenarios_are_valid_and_named_after_their_file(path: Path) -> None:
    assert load(path).name == path.stem


def test_links_lead_somewhere() -> None:
    for page in (*PAGES, "ARCHITECTURE.md", "docs/theory.md", "docs/wire.md"):
        for target in re.findall(r"\]\(([^)#:]+)\)", (ROOT / page).read_text()):
            assert (ROOT / page).parent.joinpath(target).exists(), f"{page}: {target}"
