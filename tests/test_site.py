"""Build the documentation site as `make docs` does, with warnings as errors."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from typer.main import get_command

import noack
from cosim.cli import app
from tests.pages import ROOT


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", "-b", "html", "-W", "--keep-going", "--quiet",
         "--jobs", "auto", "-d", folder / "trees", ROOT / "docs", folder / "html"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return folder / "html"


def test_every_page_command_and_public_name_is_there(site: Path) -> None:
    pages = {path.stem for path in (ROOT / "docs").glob("*.md")}
    assert pages <= {path.stem for path in site.glob("*.html")}
    commands = (site / "commands.html").read_text()
    for name in get_command(app).commands:  # type: ignore[attr-defined]
        assert f'id="noack-{name}"' in commands
    text = (site / "api.html").read_text()
    for name in set(noack.__all__) - {"__version__"}:
        assert f'id="noack.{name}"' in text


def test_the_site_serves_its_own_mathjax(site: Path) -> None:
    for name in ("theory", "derivations", "mansd"):
        page = (site / f"{name}.html").read_text()
        assert '<div class="math notranslate nohighlight">' in page or name == "mansd"
        (script,) = re.findall(r'<script[^>]*src="(_static/mathjax/[^"?]*)', page)
        assert (site / script).is_file()
        left = re.sub(r'<(div|span) class="math.*?</\1>|<script.*?</script>', "", page, flags=re.S)
        assert not re.search(r"\$|\\(?:lVert|beta|frac)", left)


def test_a_page_loads_no_external_resources(site: Path) -> None:
    for page in site.glob("*.html"):
        loaded = re.findall(r"<(?:script|link|img|iframe)\b[^>]*>", page.read_text())
        assert not [tag for tag in loaded if re.search(r'(?:src|href)="(?:https?:)?//', tag)]
    for style in site.rglob("*.css"):
        assert not re.search(r"(?:@import|url\()\s*['\"]?(?:https?:)?//", style.read_text())
