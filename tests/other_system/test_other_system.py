"""What macOS and Windows have of noack works where everything that only Linux has is missing."""

import json
import os
import subprocess
import sys
from pathlib import Path

from tests.command_line import invoke

ROOT = Path(__file__).parents[2]
CERTIFIED = (["certify", "lane_following"], ["margin", "lane_periodic", "--most", "2", "--no-period"])
COMMANDS = (
    ["simulate", "lane_following", "--set", "horizon_s=1"],
    ["summary"],
    ["replay"],
    ["fidelity"],
    *CERTIFIED,
    ["measure", "rural_n8_10kmh", "--deadline", "100ms", "--out", "measured.html"],
    ["campaign", "mb_vs_zoh", "--draws", "1", "--workers", "1"],
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


def answers(
    folder: Path, *commands: list[str]
) -> tuple[list[dict[str, object]], list[list[object]], list[str]]:
    """Run commands one after another; return their documents, how they ended, and the errors."""
    paths = [str(ROOT), str(Path(__file__).parent)]
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, json.dumps(commands)],
        cwd=folder, env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)}, capture_output=True,
        text=True, check=False, timeout=500,
    )  # fmt: skip
    found, decoder, text = [], json.JSONDecoder(), done.stdout.strip()
    while text:
        document, end = decoder.raw_decode(text)
        found.append(document)
        text = text[end:].lstrip()
    documents = [one for one in found if isinstance(one, dict)]
    return documents, [one for one in found if isinstance(one, list)], done.stderr.splitlines()


def test_simulation_theory_measurement_and_campaigns_work(tmp_path: Path) -> None:
    commands = [[*command, "--json"] for command in COMMANDS]
    documents, ends, errors = answers(tmp_path, *commands)
    assert ends == [["end", command, "other", 0] for command in commands], errors
    assert documents[0] == documents[1]  # the last run is found without a link
    assert documents[2]["bit_exact"] is True
    assert documents[4:6] == [json.loads(invoke(*command, "--json").stdout) for command in CERTIFIED]
    (run,) = (path for path in (tmp_path / "runs").iterdir() if path.name != "campaigns")
    pages = run / "report.html", tmp_path / "measured.html"
    assert all("</svg>" in page.read_text("utf-8") for page in pages)


def test_what_needs_linux_is_refused_in_one_line(tmp_path: Path) -> None:
    _, ends, errors = answers(tmp_path, *LIVE)
    assert [end[3] for end in ends] == [2] * len(LIVE), errors
    assert {line.partition(";")[0] for line in errors} == {
        "noack: live runs and the network emulator need Linux"
    }
    assert [*tmp_path.iterdir()] == []
