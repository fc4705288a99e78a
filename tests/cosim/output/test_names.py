"""Names of states, inputs and outputs: what the reader accepts reaches every output of a run."""

import io
from html import escape
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

import noack
from cosim.output.run_document import run_document
from netem.core.errors import CallerError
from netem.output.terminal_writer import print_document
from tests.helpers.command_line import invoke
from tests.helpers.named_scenario import NAMES, named_content

WRONG = ["a$_$", "$x$", "x" * 65, "x" * 200, "a\u200fb", "a\nb", "\x1b[31m", " a", "a ", "\u202eabc", ""]


@pytest.mark.parametrize("place", ["states", "inputs", "outputs"])
@pytest.mark.parametrize("name", WRONG)
def test_a_name_that_no_figure_can_show_is_refused_where_it_is_read(place: str, name: str) -> None:
    names = {"states": ["p", "v"], "inputs": ["u"], "outputs": ["y"]}
    names[place][0] = name
    with pytest.raises(CallerError) as error:
        noack.load(named_content(**names))
    assert len(str(error.value).splitlines()) == 1


@settings(max_examples=1, deadline=None)
@given(st.lists(NAMES, min_size=5, max_size=5, unique=True))
def test_a_name_that_is_accepted_reaches_every_output(
    tmp_path_factory: pytest.TempPathFactory, names: list[str]
) -> None:
    assert_survives(tmp_path_factory.mktemp("named"), names)


@pytest.mark.parametrize("names", [
    ["lateral offset [m]", "<b>", "{}", "x" * 64, "[/]"],
    pytest.param(["a\\", "a/b", "_x", "=1+1", "שלום"], marks=pytest.mark.deep),
    pytest.param(["%s", "{0}", "[bold]x", "..", "&amp;"], marks=pytest.mark.deep),
])  # fmt: skip
def test_unusual_names_reach_every_output(tmp_path: Path, names: list[str]) -> None:
    assert_survives(tmp_path, names)


def assert_survives(folder: Path, names: list[str]) -> None:
    """Run a scenario with these names, and write everything that noack writes of a run."""
    run = noack.simulate(noack.load(named_content(names[:2], names[2:3], names[3:])), runs=folder / "runs")
    opened = noack.open_run(run.directory)
    assert [output.name for loop in opened.summary.loops for output in loop.outputs] == names[3:]
    screen = io.StringIO()
    print_document(Console(file=screen, width=300), run_document(run._outcome))
    assert names[3] in screen.getvalue()
    assert escape(names[3], quote=False) in run.report().read_text()
    assert all(path.stat().st_size for path in run.save_figures("svg"))
    assert run.save_tables(folder / "tables")
    assert run.export(folder / "run.mat", certificates=False)
    assert run.export(folder / "csv")


def test_a_bracket_in_the_name_of_an_output_is_shown_by_the_command(tmp_path: Path) -> None:
    case = Path(__file__).parents[2] / "cases" / "bracket.toml"
    assert invoke("simulate", case, "--no-report", "--runs", tmp_path).exit_code == 0
    assert "lateral offset [m] was at most 3 m" in invoke("summary", tmp_path / "latest").stdout
