"""CITATION.cff follows the Citation File Format 1.2.0, and agrees with the package."""

import re
import tomllib
from typing import Any

import pytest
import yaml

from tests.pages import ROOT

KEYS = {
    "": {
        "abstract", "authors", "cff-version", "commit", "contact", "date-released", "doi",
        "identifiers", "keywords", "license", "license-url", "message", "preferred-citation",
        "references", "repository", "repository-artifact", "repository-code", "title", "type",
        "url", "version",
    },
    "references": {
        "abbreviation", "abstract", "authors", "collection-title", "conference", "copyright",
        "date-published", "doi", "editors", "identifiers", "institution", "issue", "journal",
        "keywords", "languages", "license", "month", "notes", "number", "pages", "publisher",
        "start", "end", "status", "title", "type", "url", "version", "volume", "year",
    },
    "authors": {
        "affiliation", "alias", "email", "family-names", "given-names", "name", "name-particle",
        "name-suffix", "orcid", "website",
    },
    "identifiers": {"type", "value", "description"},
}  # fmt: skip
"""Keys that the schema allows, by the list of an object; of ``references`` the common ones."""
REQUIRED = {
    "": {"authors", "cff-version", "message", "title"},
    "references": {"authors", "title", "type"},
    "authors": set[str](),
    "identifiers": {"type", "value"},
}
REFERENCE_TYPES = {
    "article", "book", "conference-paper", "report", "software", "thesis", "unpublished",
}  # fmt: skip


@pytest.fixture(scope="module")
def citation() -> dict[str, Any]:
    """The file; a date or a version is a text, as in it."""
    text = (ROOT / "CITATION.cff").read_text()
    found: dict[str, Any] = yaml.load(text, yaml.BaseLoader)
    return found


def objects(value: Any, place: str = "") -> list[tuple[str, dict[str, Any]]]:
    if isinstance(value, list):
        return [one for entry in value for one in objects(entry, place)]
    if isinstance(value, dict):
        inner = [one for key, entry in value.items() for one in objects(entry, key)]
        return [(place, value), *inner]
    return []


def test_objects_have_the_keys_of_the_schema(citation: dict[str, Any]) -> None:
    found = objects(citation)
    assert {place for place, _ in found} == KEYS.keys()
    for place, one in found:
        assert REQUIRED[place] <= one.keys() <= KEYS[place], place


def test_values_have_the_types_of_the_schema(citation: dict[str, Any]) -> None:
    assert citation["cff-version"] == "1.2.0"
    assert citation["type"] in ("software", "dataset")
    assert all(isinstance(keyword, str) for keyword in citation["keywords"])
    for person in citation["authors"]:
        assert ("name" in person) != ("family-names" in person)
    for reference in citation["references"]:
        assert reference["type"] in REFERENCE_TYPES
        assert re.fullmatch(r"\d{4}", reference["year"])
        assert re.fullmatch(r"https://\S+", reference["url"])
    for place, one in objects(citation):
        assert place != "identifiers" or one["type"] in ("doi", "url", "swh", "other")


def test_the_citation_agrees_with_the_package(citation: dict[str, Any]) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert (citation["version"], citation["license"]) == (project["version"], project["license"])
    assert citation["title"].startswith(project["name"] + ":")


def test_the_paper_is_a_reference(citation: dict[str, Any]) -> None:
    (paper,) = citation["references"]
    readme = " ".join((ROOT / "README.md").read_text().split())
    assert paper["title"] in readme
    assert [one["family-names"] for one in paper["authors"]] == ["Garcia", "Antsaklis"]
