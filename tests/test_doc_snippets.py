"""Run the Python programs of the documentation."""

from pathlib import Path

import pytest

from tests.pages import blocks, fill


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fill(tmp_path_factory.mktemp("docs"))


def snippets() -> list[str]:
    """Return programs; a snippet that begins with a file name is a file instead."""
    pages = ("docs/plants.md", "docs/record.md", "docs/library.md", "docs/howto.md")
    found = [code for page in pages for code in blocks(page, "python")]
    return [snippet for snippet in found if not snippet.startswith("#")]


@pytest.mark.parametrize("snippet", snippets())
def test_every_snippet_runs(
    snippet: str, run_folder: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(run_folder)
    exec(compile(snippet, "snippet", "exec"), {"__name__": "__main__"})
    assert capsys.readouterr().out.strip()
