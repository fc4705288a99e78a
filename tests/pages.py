"""The documentation's pages, and a folder in which their commands and snippets can run."""

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = (
    "README.md", "docs/record.md", "docs/scenarios.md", "docs/paper.md", "docs/netem.md",
    "docs/netem-programs.md", "docs/campaigns.md", "docs/design.md", "docs/plants.md",
    "docs/library.md", "docs/command-line.md", "docs/howto.md", "docs/guarantees.md",
    "docs/benchmarks.md", "docs/measure.md", "docs/capacity.md", "docs/papers.md",
)  # fmt: skip


def blocks(page: str, language: str) -> list[str]:
    text = (ROOT / page).read_text()
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def fill(folder: Path) -> Path:
    """Give a folder the repository's files and a short run; return it."""
    (folder / "scenarios").symlink_to(ROOT / "scenarios")
    (folder / "docs").symlink_to(ROOT / "docs")
    (links,) = blocks("docs/netem.md", "toml")
    (folder / "links.toml").write_text(links)
    for code in [*blocks("docs/plants.md", "python"), *blocks("docs/plants.md", "toml")]:
        if (named := re.match(r"# (\w+\.(?:py|toml))\n", code)) is not None:
            (folder / named[1]).write_text(code)
        elif code.startswith("import control"):  # this snippet writes the matrices file
            subprocess.run([sys.executable, "-c", code], cwd=folder, check=True)
    result = subprocess.run(
        [
            sys.executable, "-m", "cosim.cli", "run", "lane_following", "--json",
            "--set", "ports={}", "--set", "horizon_s=2",
        ],
        cwd=folder, capture_output=True, text=True, check=False, timeout=250,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    for name in ("model", "hold"):  # two runs for `compare`, as commands run in any order
        (folder / "runs" / name).mkdir()
        (folder / "runs" / name / "latest").symlink_to((folder / "runs/latest").resolve())
    return folder
