"""The documentation: its words and tables against the code, CITATION.cff, and the built site."""

import json
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import yaml
from pydantic import BaseModel
from typer.main import get_command

import noack
from cosim.analysis.scenario_certificates import certificate_of, quick_certificate
from cosim.analysis.witnesses import find_statement
from cosim.cli.application import app
from cosim.output.page_kit import glossary
from cosim.studies.campaign.campaign_file import Campaign, CampaignAxis, Figure, Metrics, PairedComparison
from cosim.studies.campaign.campaign_file import load as load_campaign
from cosim.studies.campaign.campaign_grid import grid
from cosim.studies.campaign.metrics import METRICS
from netem.core.number_format import at_most, number
from netem.core.toml_file import json_schema
from netem.impairments.constraints import CONSTRAINTS
from netem.impairments.disciplines import DISCIPLINES
from netem.impairments.kinds import IMPAIRMENTS
from netem.impairments.loss_models import LOSS_MODELS
from netem.tc_words import KEYWORDS
from noack.controllers.controller_settings import ControllerSettings
from noack.proof.elaborate.keys import key_table
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load
from noack.scenario.sections import POLICIES, AnyDisturbance, AnyObserver
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import allowed_conditions
from tests.helpers.pages import PAGES, ROOT, blocks
from tests.helpers.shipped import resolved


def keys_of(section: type[BaseModel], prefix: str = "") -> Iterator[str]:
    for key, field in section.model_fields.items():
        kind = ControllerSettings if prefix + key == "controller" else field.annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            yield from keys_of(kind, f"{prefix}{key}.")
        else:
            yield prefix + key


def choices(union: Any) -> tuple[type[BaseModel], ...]:
    """Return the member models of an annotated union."""
    tables: tuple[type[BaseModel], ...] = get_args(get_args(union)[0])
    return tables


def test_every_scenario_key_is_documented_and_no_other() -> None:
    assert json.loads((ROOT / "docs/scenario.schema.json").read_text()) == json_schema(Scenario)
    text = (ROOT / "docs/scenarios.md").read_text()
    keys = text.partition("## Plants")[0]
    assert documented_keys(keys) == set(keys_of(Scenario))


@pytest.mark.parametrize(
    ("page", "heading", "tables"),
    [
        ("scenarios", "Trigger policies", POLICIES.values()),
        ("scenarios", "Disturbances", (*choices(AnyDisturbance), *choices(AnyObserver))),
        ("network", "Loss models", (*LOSS_MODELS, *IMPAIRMENTS, *DISCIPLINES, *CONSTRAINTS)),
    ],
)
def test_every_key_of_a_kind_is_documented(
    page: str, heading: str, tables: Iterable[type[BaseModel]]
) -> None:
    text = (ROOT / f"docs/{page}.md").read_text().partition(f"## {heading}")[2]
    for table in tables:
        first, *_ = table.model_fields.values()
        name = get_args(first.annotation)[0]
        row, *_ = (line for line in text.splitlines() if line.startswith(f"| `{name}`"))
        _, _, cells = row.partition("|")
        if heading == "Loss models":
            named = re.findall("([a-z_0-9]+) = ", cells)
        else:
            named = re.findall(r"`([A-Za-z_]\w*)", cells.split("|")[-2])
        no_keys = {"model", "kind", "policy", "weight", "disturbances", "measurement"}
        assert set(named) - no_keys == table.model_fields.keys() - no_keys, name


def test_every_word_of_the_emulator_is_documented_and_understood() -> None:
    text = (ROOT / "docs/netem.md").read_text().partition("## The words")[2]
    rows = [line.split("|")[1] for line in text.splitlines() if line.startswith("| `")]
    documented = {word for row in rows for word in re.findall(r"[a-z]+", row)}
    for word in KEYWORDS:
        assert word in documented or f"`{word}`" in text, word


def documented_keys(text: str) -> set[str]:
    """Names in the left column of tables; a leading dot: the section of the row's first name."""
    rows = [line.split("|")[1] for line in text.splitlines() if line.startswith("| `")]
    keys: set[str] = set()
    for row in rows:
        names = re.findall(r"`([^`]+)`", row)
        section = names[0].partition(".")[0]
        keys |= {name if not name.startswith(".") else section + name for name in names}
    return keys


def test_every_key_of_a_campaign_is_documented_and_no_other() -> None:
    page = (ROOT / "docs/campaigns.md").read_text()
    shipped = {path.stem for path in (ROOT / "campaigns").glob("*.toml")}
    assert documented_keys(page.partition("## The file")[0]) == shipped
    assert documented_keys(page.partition("## Metrics")[2].partition("##")[0]) == METRICS.keys()
    text = page.partition("## The file")[2].partition("## Draws")[0]
    sections = {"axes": CampaignAxis, "metrics": Metrics, "compare": PairedComparison}
    keys = set(Campaign.model_fields) - {"metrics", "compare"} | {"figures.kind", "figures.where"}
    keys |= {f"{name}.{key}" for name, section in sections.items() for key in section.model_fields}
    figures = {table.model_fields["kind"].default: table for table in choices(Figure)}
    assert documented_keys(text) == keys | figures.keys()
    for name, table in figures.items():
        (row,) = [line for line in text.splitlines() if line.startswith(f"| `{name}` |")]
        assert set(re.findall("([a-z]+) = ", row)) == table.model_fields.keys() - {"kind", "where"}


def test_the_documented_campaign_is_valid(tmp_path: Path) -> None:
    text = "\n".join(blocks("docs/campaigns.md", "toml"))
    path = tmp_path / "thresholds.toml"
    path.write_text(text)
    assert len(grid(load_campaign(path), path)) == 9


def test_every_option_of_design_is_documented_and_no_other() -> None:
    text = (ROOT / "docs/design.md").read_text().partition("## Options")[2]
    rows = [line.split("|")[1] for line in text.splitlines() if line.startswith("| `")]
    documented = {name for row in rows for name in re.findall("--[A-Za-z-]+", row)}
    parameters = get_command(app).commands["design"].params  # type: ignore[attr-defined]
    known = {name for parameter in parameters for name in parameter.opts if name.startswith("--")}
    assert documented | {"--help"} == known | {"--help"}


def test_the_table_of_commands_names_every_command() -> None:
    """Those of the core; extensions that are installed add others."""
    text = (ROOT / "README.md").read_text().partition("## What noack can do")[2].partition("## ")[0]
    named = {
        word
        for line in text.splitlines()
        if line.startswith("| `")
        for word in re.findall("`([a-z]+)`", line.split("|")[1])
    }
    folder = ROOT / "cosim" / "cli" / "commands"
    core = {path.stem for path in folder.glob("*.py")}
    commands = get_command(app).commands  # type: ignore[attr-defined]
    own = {
        name for name, command in commands.items() if command.callback.__module__.rpartition(".")[2] in core
    }
    assert named == own


def test_the_network_in_the_how_to_page_is_valid(tmp_path: Path) -> None:
    (network,) = blocks("docs/howto.md", "toml")
    text = (ROOT / "scenarios/unstable_pendulum.toml").read_text()
    path = tmp_path / "pendulum.toml"
    path.write_text(re.sub(r"^\[network\]\n.*?\n\n", network + "\n", text, flags=re.DOTALL | re.M))
    assert [impairment.kind for impairment in load(path).network.impairments] == ["delay", "rate"]


TEXTS = sorted({*(ROOT / "docs").glob("*.md"), *map(ROOT.joinpath, PAGES), *ROOT.glob("*.md")})
FOLDERS = sorted(path.parent.name for path in ROOT.glob("*/__init__.py"))
OTHER_FOLDERS = ["benchmarks", "campaigns", "docs", "scenarios", "tests", "tools"]


def anchors(page: Path) -> set[str]:
    """The names that GitHub and the site give to the sections of a page."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", TEXTS, ids=lambda page: page.name)
def test_links_and_paths_have_existing_targets(page: Path) -> None:
    text = page.read_text()
    for target, section in re.findall(r"\]\(([^)#:\s]*)#?([^):\s]*)\)", text):
        path = page.parent / target if target else page
        assert path.exists(), f"{page.name}: {target}"
        if section and path.suffix == ".md":
            assert section in anchors(path), f"{page.name}: {target}#{section}"
    folders = "|".join([*FOLDERS, *OTHER_FOLDERS])
    for named in re.findall(rf"`((?:{folders})/[\w./-]*)`", text):
        if not re.search(r"\b[A-Z]+\b", named):  # netem/NAME
            assert (ROOT / named).exists(), f"{page.name}: {named}"


def test_the_map_of_the_code_names_existing_files() -> None:
    files = {path.name for folder in (*FOLDERS, "native") for path in (ROOT / folder).rglob("*.py")}
    named = set(re.findall(r"`(\w+\.py)`", (ROOT / "ARCHITECTURE.md").read_text()))
    assert len(named) > 20
    assert named <= files


def test_the_tour_of_the_code_names_existing_places() -> None:
    page = (ROOT / "docs/tour.md").read_text()
    stops = re.findall(r"^\| \[(\S+)\]\(\.\./(\S+)\) \| (.*?) \| (\d+) \|", page, re.MULTILINE)
    assert len(stops) > 20
    for label, target, names, lines in stops:
        text = (ROOT / target).read_text()
        assert label == target
        assert int(lines) <= len(text.splitlines()), target
        for name in re.findall(r"`(\w+)`", names):
            begins = rf"^\s*(def|class) {name}\b" if target.endswith(".py") else rf"^\w.*\b{name}\("
            assert re.search(begins, text, re.MULTILINE), f"{target}: {name}"
    assert 2500 < sum(int(lines) for *_, lines in stops) < 3500


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
    assert [author["family-names"] for author in paper["authors"]] == ["Garcia", "Antsaklis"]
    assert re.fullmatch(r"\d{4}", paper["year"])


def test_the_glossary_of_the_documentation_is_that_of_the_program() -> None:
    assert glossary() in (ROOT / "docs/glossary.md").read_text(encoding="utf-8")


REFUSED_BY_ANOTHER_ROW = {
    "plant.measurement.noise_std": "plant.disturbances.kind",
    "plant.disturbances.std": "plant.disturbances.kind",
    "network.acknowledgements.*": "network.protocol",
}


def test_the_table_of_the_limits_names_every_key_that_is_refused() -> None:
    """But keys that no resolved scenario has, and those of what is refused as a whole."""
    refused = {
        REFUSED_BY_ANOTHER_ROW.get(key, key)
        for key, rows in key_table().rows.items()
        for row in rows
        if row.use == "refused" and not row.reason.startswith("of ") and "resolved" not in row.reason
    }
    text = (ROOT / "docs/limits.md").read_text(encoding="utf-8").partition("| key | refused |")[2]
    named = {key for cell in re.findall(r"^\| (`.+?) \|", text, re.MULTILINE) for key in cell.split("`")}
    assert len(refused) >= 8
    assert refused <= named, refused - named


# --- bounds and sizes -----------------------------------------------------------------------------


@cache
def by_gains(name: str) -> ScenarioCertificate:
    return quick_certificate(resolved(name))


def bound_on_page(certificate: ScenarioCertificate, in_the_limit: str) -> str:
    bound = certificate.state(np.zeros(1))[0]
    return at_most(certificate.ultimate_state if in_the_limit else bound, digits=3)


def bounds_of_theory() -> tuple[list[tuple[str, str, str, str]], str]:
    """Name, whether in the limit, by gains and after a search, of each row; the text below the table."""
    text = (ROOT / "docs/theory.md").read_text(encoding="utf-8")
    below = text.partition("| scenario | by gains, at t = 0 |")[2].partition("**The checker**")[0]
    row = r"^\| `(\w+)`(, in the limit)? \| ([0-9.]+) \| ([0-9.]+) \|"
    rows = re.findall(row, below, re.MULTILINE)
    assert len(rows) == 5
    return rows, below


@pytest.mark.usefixtures("nothing_was_found_before")
def test_the_bounds_by_gains_on_the_page_of_the_theory_are_proven() -> None:
    rows, below = bounds_of_theory()
    for name, in_the_limit, value, _ in rows:
        assert (name, value) == (name, bound_on_page(by_gains(name), in_the_limit))
    others = re.findall(r"`(\w+)`\s\(([0-9.]+)\)", below)
    assert len(others) == 2
    for name, value in others:
        assert (name, value) == (name, bound_on_page(by_gains(name), ""))


@pytest.mark.deep  # a minute of CPU time
@pytest.mark.usefixtures("nothing_was_found_before")
def test_the_bounds_after_a_search_on_the_page_of_the_theory_are_found() -> None:
    """To 1 %: the command searches other statements first, and begins with what it found for them."""
    for name, in_the_limit, _, value in bounds_of_theory()[0]:
        scenario = resolved(name)
        statement = find_statement(scenario, "own", "schedule")
        found = certificate_of(scenario, statement, allowed_conditions(scenario))
        assert float(value) == pytest.approx(float(bound_on_page(found, in_the_limit)), rel=0.01), name


@pytest.mark.usefixtures("nothing_was_found_before")
def test_a_bound_in_a_comment_of_a_scenario_is_proven() -> None:
    found = 0
    for path in (ROOT / "scenarios").glob("*.toml"):
        for first, rate, rest in re.findall(
            r"#.*?([0-9.]+) e\^\(-([0-9.]+) t\) \+ ([0-9.]+[0-9])", path.read_text(encoding="utf-8")
        ):
            found += 1
            proven = by_gains(path.stem).proven
            assert proven is not None
            bound = proven.bounds["x"]
            assert (first, rate, rest) == (
                at_most(bound.decaying), number(proven.rate_per_s), at_most(bound.constant),
            )  # fmt: skip
    assert found


def test_what_has_to_be_believed_is_listed_with_its_size() -> None:
    text = (ROOT / "docs/theory.md").read_text(encoding="utf-8").partition("| who wants to believe |")[2]
    rows = re.findall(r"^\| .+ \| .*`([\w/.]+)` \| ([0-9,]+) \|", text.partition("\n\n")[0], re.M)
    assert len(rows) == 5
    for place, lines in rows:
        path = ROOT / place
        files = [path] if path.is_file() else sorted(path.glob("*.py"))
        size = sum(len(file.read_text(encoding="utf-8").splitlines()) for file in files)
        assert abs(size - int(lines.replace(",", ""))) < 100, (place, size)


# --- the site -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    result = subprocess.run(
        [sys.executable, "-m", "sphinx", "-b", "html", "-W", "--keep-going", "--quiet",
         "--jobs", "auto", "-d", folder / "trees", ROOT / "docs", folder / "html"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    return folder / "html"


@pytest.mark.system
def test_every_page_command_and_public_name_is_there(site: Path) -> None:
    pages = {path.stem for path in (ROOT / "docs").glob("*.md")}
    assert pages <= {path.stem for path in site.glob("*.html")}
    commands = (site / "commands.html").read_text()
    for name in get_command(app).commands:  # type: ignore[attr-defined]
        assert f'id="noack-{name}"' in commands
    text = (site / "api.html").read_text()
    for name in set(noack.__all__) - {"__version__"}:
        assert f'id="noack.{name}"' in text


@pytest.mark.system
def test_the_site_serves_its_own_mathjax(site: Path) -> None:
    for name in ("theory", "derivations", "mansd"):
        page = (site / f"{name}.html").read_text()
        assert '<div class="math notranslate nohighlight">' in page or name == "mansd"
        (script,) = re.findall(r'<script[^>]*src="(_static/mathjax/[^"?]*)', page)
        assert (site / script).is_file()
        left = re.sub(r'<(div|span) class="math.*?</\1>|<script.*?</script>', "", page, flags=re.S)
        assert not re.search(r"\$|\\(?:lVert|beta|frac)", left)


@pytest.mark.system
def test_a_page_loads_no_external_resources(site: Path) -> None:
    for page in site.glob("*.html"):
        loaded = re.findall(r"<(?:script|link|img|iframe)\b[^>]*>", page.read_text())
        assert not [tag for tag in loaded if re.search(r'(?:src|href)="(?:https?:)?//', tag)]
    for style in site.rglob("*.css"):
        assert not re.search(r"(?:@import|url\()\s*['\"]?(?:https?:)?//", style.read_text())
