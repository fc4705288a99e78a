"""The project's words: what each means, for the report, the lab page and ``docs/glossary.md``."""

import tomllib
from pathlib import Path

_FILE = Path(__file__).with_suffix(".toml")
TERMS: tuple[tuple[str, str], ...] = tuple(
    (entry["term"], entry["meaning"])
    for entry in tomllib.loads(_FILE.read_text(encoding="utf-8"))["terms"]
)
"""Terms and their meanings, in an order in which each uses earlier ones only."""


def as_markdown() -> str:
    """Return the terms as the table of ``docs/glossary.md``."""
    rows = [f"| **{term}** | {meaning} |" for term, meaning in TERMS]
    return "\n".join(["| term | meaning |", "|---|---|", *rows])
