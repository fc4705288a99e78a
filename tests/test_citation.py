"""CITATION.cff agrees with the package and the README."""

import re
import tomllib

import yaml

from tests.pages import ROOT

REQUIRED = {"authors", "cff-version", "message", "title"}
"""Of the Citation File Format 1.2.0."""


def test_the_citation_agrees_with_the_package() -> None:
    citation = yaml.load((ROOT / "CITATION.cff").read_text(), yaml.BaseLoader)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert citation.keys() >= REQUIRED
    assert citation["cff-version"] == "1.2.0"
    assert (citation["version"], citation["license"]) == (project["version"], project["license"])
    assert citation["title"].startswith(project["name"] + ":")
    (paper,) = citation["references"]
    assert paper["title"] in " ".join((ROOT / "README.md").read_text().split())
    assert [one["family-names"] for one in paper["authors"]] == ["Garcia", "Antsaklis"]
    assert re.fullmatch(r"\d{4}", paper["year"])
