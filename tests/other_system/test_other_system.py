"""What macOS and Windows have of noack works where everything that only Linux has is missing."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.helpers.command_line import invoke

pytestmark = pytest.mark.system
ROOT = Path(__file__).parents[2]
CERTIFIED = (
    ["certify", "lane_following", "--json"],
    ["margin", "lane_periodic", "--most", "2", "--no-period", "--json"],
)
COMMANDS = (
    ["simulate", "lane_following", "--set", "horizon_s=1", "--json"],
    ["summary", "--json"],
    ["replay", "--json"],
    *CERTIFIED,
    ["measure", "rural_n8_10kmh", "--deadline", "100ms", "--out", "measured.html", "--json"],
    ["campaign", "mb_vs_zoh", "--draws", "1", "--workers", "1", "--json"],
)
LIVE = (["demo"], ["run", "lane_following"], ["doctor"], ["netem", "loss", "5%"], ["plant"])
PROGRAM = """
import json, runpy, sys
for words in json.loads(sys.argv[1]):
    sys.argv = ["noack", *words]
    try:
        runpy.run_module("cosim.cli", run_name="__main__")
    except SystemExit as end:
        print(json.dumps(["end", words, sys.platform, end.code]))
"""


class Answers(NamedTuple):
    """What the commands left in a folder, printed as documents, how each ended, and the errors."""

    folder: Path
    documents: list[dict[str, object]]
    ends: list[list[object]]
    errors: list[str]


@pytest.fixture(scope="module")
def answers(tmp_path_factory: pytest.TempPathFactory) -> Answers:
    """Run all commands one after another, in one process."""
    folder = tmp_path_factory.mktemp("other_system")
    paths = [str(ROOT), str(Path(__file__).parent)]
    result = subprocess.run(
        [sys.executable, "-c", PROGRAM, json.dumps([*LIVE, *COMMANDS])],
        cwd=folder, env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)}, capture_output=True,
        text=True, check=False, timeout=500,
    )  # fmt: skip
    answers, decoder, text = [], json.JSONDecoder(), result.stdout.strip()
    while text:
        document, end = decoder.raw_decode(text)
        answers.append(document)
        text = text[end:].lstrip()
    documents = [document for document in answers if isinstance(document, dict)]
    ends = [document for document in answers if isinstance(document, list)]
    return Answers(folder, documents, ends, result.stderr.splitlines())


def test_simulation_theory_measurement_and_campaigns_work(answers: Answers) -> None:
    documents = answers.documents
    assert answers.ends[len(LIVE) :] == [["end", command, "other", 0] for command in COMMANDS], answers.errors
    assert documents[0] == documents[1]  # the last run is found without a link
    assert documents[2]["bit_exact"] is True
    assert documents[4:6] == [json.loads(invoke(*command).stdout) for command in CERTIFIED]
    (run,) = (path for path in (answers.folder / "runs").iterdir() if path.name != "campaigns")
    pages = run / "report.html", answers.folder / "measured.html"
    assert all("</svg>" in page.read_text("utf-8") for page in pages)


def test_what_needs_linux_is_refused_in_one_line(answers: Answers) -> None:
    assert [end[3] for end in answers.ends[: len(LIVE)]] == [2] * len(LIVE)
    lines = [line.partition(";")[0] for line in answers.errors[: len(LIVE)]]
    assert lines == ["noack: live runs and the network emulator need Linux"] * len(LIVE)
    assert {path.name for path in answers.folder.iterdir()} == {"runs", "measured.html"}  # of the others
