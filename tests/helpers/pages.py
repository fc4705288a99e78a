"""The documentation's pages, and a folder in which their commands and snippets can run."""

import re
import shlex
import subprocess
from contextlib import chdir
from pathlib import Path

from tests.helpers.command_line import invoke

ROOT = Path(__file__).parents[2]
PAGES = (
    "README.md", "docs/record.md", "docs/scenarios.md", "docs/network.md", "docs/many-loops.md",
    "docs/paper.md", "docs/netem.md", "docs/netem-programs.md", "docs/campaigns.md",
    "docs/design.md", "docs/plants.md", "docs/library.md", "docs/command-line.md", "docs/howto.md",
    "docs/guarantees.md", "docs/benchmarks.md", "docs/measure.md", "docs/choosing-mansd.md",
    "docs/papers.md", "docs/published.md", "docs/theory.md",
)  # fmt: skip


def fences(page: str | Path) -> list[tuple[str, str]]:
    """Language and content of the fenced blocks of a page, in order."""
    text = (ROOT / page).read_text(encoding="utf-8")
    return re.findall(r"^```(\w*)\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def blocks(page: str | Path, language: str) -> list[str]:
    """Return the fenced blocks of a language."""
    return [content for block_language, content in fences(page) if block_language == language]


def target_exists(command: str) -> bool:
    """Whether make knows the target of a command; running it could run the tests again."""
    dry = ["make", "--dry-run", *shlex.split(command)[1:]]
    return subprocess.run(dry, cwd=ROOT, capture_output=True, check=False).returncode == 0


def fill(folder: Path) -> Path:
    """Give a folder the repository's files and a short run; return it."""
    (folder / "scenarios").symlink_to(ROOT / "scenarios")
    (folder / "docs").symlink_to(ROOT / "docs")
    links, office = blocks("docs/netem.md", "toml")
    (folder / "links.toml").write_text(links)
    (folder / "office.toml").write_text(office)
    (timetable,) = (text for text in blocks("docs/netem.md", "text") if text.startswith("time_s,"))
    (folder / "tunnel.csv").write_text(timetable)
    for code in [*blocks("docs/plants.md", "python"), *blocks("docs/plants.md", "toml")]:
        if (named := re.match(r"# (\w+\.(?:py|toml))\n", code)) is not None:
            (folder / named[1]).write_text(code)
        elif code.startswith("import control"):  # this snippet writes the matrices file
            with chdir(folder):
                exec(compile(code, "snippet", "exec"), {"__name__": "__main__"})
    run = invoke("simulate", "lane_following", "--set=horizon_s=2", "--no-report", "--runs", folder / "runs")
    assert run.exit_code == 0, run.stderr
    network = ("--deadline", "100ms", "--as", "model", "--write", folder / "urban.toml")
    preset = ("--preset", str(folder / "rural.toml"))
    assert invoke("measure", "urban_n78_40kmh", *network, *preset).exit_code == 0
    for name in ("model", "hold"):  # two runs for `compare`, as commands run in any order
        (folder / "runs" / name).mkdir()
        (folder / "runs" / name / "latest").symlink_to((folder / "runs/latest").resolve())
    return folder
