"""Compiles LaTeX documents, if this machine has a LaTeX."""

import shutil
import subprocess
from pathlib import Path

import pytest

COMPILERS = {
    "pdflatex": ("-interaction=nonstopmode", "-halt-on-error", "-no-shell-escape"),
    "tectonic": ("--only-cached",),
}


def compiled(body: str, packages: tuple[str, ...], folder: Path) -> Path:
    """The PDF of a document with this body; without a LaTeX, or its packages, the test skips."""
    name = next((name for name in COMPILERS if shutil.which(name)), None)
    if name is None:
        pytest.skip(f"needs one of {', '.join(COMPILERS)}")
    lines = [r"\documentclass{article}", *(rf"\usepackage{{{one}}}" for one in packages)]
    document = "\n".join([*lines, r"\begin{document}", body, r"\end{document}", ""])
    (folder / "document.tex").write_text(document, encoding="utf-8")
    done = subprocess.run(
        [name, *COMPILERS[name], "document.tex"], cwd=folder, capture_output=True, timeout=300
    )
    output = done.stdout.decode(errors="replace")
    if ".sty' not found" in output:
        pytest.skip(f"{name} lacks a package of {', '.join(packages)}")
    assert done.returncode == 0, output[-3000:]
    return folder / "document.pdf"
