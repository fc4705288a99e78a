"""Names of states, inputs and outputs on the page: what the reader accepts is drawn, also in an explorer."""

import json
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import noack
import noack_lab
from noack_lab import results
from noack_lab.chart import Drawn, chart_options
from tests.helpers.named_scenario import NAMES, named_content


@settings(max_examples=2, deadline=None)
@given(st.lists(NAMES, min_size=5, max_size=5, unique=True))
def test_names_that_are_accepted_are_drawn(
    tmp_path_factory: pytest.TempPathFactory, names: list[str]
) -> None:
    assert_drawn(names, tmp_path_factory.mktemp("named"))


@pytest.mark.parametrize("names", [
    ["lateral offset [m]", "<b>", "{}", "x" * 64, "[/]"],
    ["error norms", "norm of the state", "lost", "delivered", "x plant"],
    ["output x", "input", "input", "x", "state input"],
])  # fmt: skip
def test_unusual_names_are_drawn(names: list[str], tmp_path: Path) -> None:
    assert_drawn(names, tmp_path)


def assert_drawn(names: list[str], folder: Path) -> None:
    """Draw a run of a scenario with these names: exact, recorded, and in an explorer."""
    scenario = noack.load(named_content(names[:2], names[2:3], names[3:]))
    exact = results.run_of(scenario)
    run = noack.simulate(scenario, runs=folder)
    recorded = results.recorded_run(run.directory, None)
    bounds = results.guarantee_of(scenario).curves
    for shown in (exact, recorded):
        assert [state.removeprefix("state ") for state in shown.states] == [
            name.removeprefix("state ") for name in names[:2]
        ]
        for state in shown.states:
            options = chart_options(Drawn(shown, state, bounds, exact))
            json.dumps(options, allow_nan=False)
            titles = [title["text"] for title in options["title"]]
            wanted = [state, *(f"|{name}| (logarithmic)" for name in names[3:])]
            wanted += ["error norms (logarithmic)", "norm of the state (logarithmic)"]
            assert titles[: len(wanted)] == wanted
    assert len(recorded.transmissions) == len(run.events())
    assert len(exact.transmissions) >= 1
    assert results.compare(exact, exact)
    assert results.report_page(run.directory)
    explorer = noack_lab.explore(scenario)
    assert explorer.figure(exact.states[1]).axes
    assert noack.load(explorer.save(folder / "saved.toml")).outputs == scenario.outputs
