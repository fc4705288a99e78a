"""Every mistake in a scenario gives one line: file, key, value, and the remedy."""

import os
import re
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import tomli_w

import noack
from noack.core.errors import CallerError
from noack.scenario.resolution import resolve, resolved_loops
from noack.scenario.scenario_file import dumps, load, put, validate, value_of

SHIPPED = sorted((Path(__file__).parents[3] / "scenarios").glob("*.toml"))
Content = dict[str, Any]

LANE = """
name = "lane"
horizon_s = 20.0
model = { name = "lane_following" }
[plant]
draw = "uniform"
uncertainty_A = [[0.1, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]
initial_state = [0.5, 0.0, 0.1, 3.0]
[trigger]
beta = 0.5
alpha_per_s = 0.25
[network]
mansd = 4
loss = { model = "bernoulli", probability = 0.8 }
[ports]
plant = 47001
"""

DOUBLE = """
name = "double"
horizon_s = 1.0
model = { A = [[0, 1], [0, 0]], B = [[0], [1]], gain = [[-1, -1.5]] }
plant = { initial_state = [1, 0] }
trigger = { beta = 0.5, alpha_per_s = 0.25 }
network = { mansd = 2, loss = { model = "worst_case" } }
"""


def mistakes(text: str, folder: Path, lines: Sequence[str] = ()) -> list[str]:
    """The error message for a scenario file with these ``key=value`` settings added."""
    return mistakes_with(content_with(text, lines), folder, ())


def content_with(text: str, lines: Sequence[str]) -> str:
    content = tomllib.loads(text)
    for line in lines:
        key, _, value = line.partition("=")
        put(content, key, value_of(value, key), key)
    return tomli_w.dumps(content)


def mistakes_with(text: str, folder: Path, settings: Sequence[str]) -> list[str]:
    """The error message for these settings, with the file's name shortened to FILE."""
    path = folder / "some.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(CallerError) as caught:
        resolve(load(path, settings))
    return str(caught.value).replace(str(path), "FILE").split("\n")


_SUGGESTED = re.compile(r"(?:try|e\.g\.|% is) (\[.*\]|[\d.]+)$")


def test_the_lines_about_mistakes_are_those_that_were_approved(tmp_path: Path) -> None:
    """``APPROVE=1 pytest`` writes them anew: read the difference. What they suggest is valid."""
    page, text = Path(__file__).with_name("mistakes.txt"), ""
    found: list[str] = []
    for line in page.read_text(encoding="utf-8").splitlines():
        if line.startswith("    "):
            continue
        found.append(line)
        if line.startswith("# "):
            text = {"# LANE": LANE, "# DOUBLE": DOUBLE}[line]
        elif text:
            about = mistakes(text, tmp_path, line.split(" & "))
            found += [f"    {one.removeprefix('FILE: ')}" for one in about]
            if suggested := _SUGGESTED.search(about[0]):
                key = about[0].removeprefix("FILE: ").partition(" = ")[0].removesuffix(".0")
                right = [*line.split(" & "), f"{key}={suggested[1]}", "model.allow_unstable=true"]
                validate(tomllib.loads(content_with(text, right)), "here")
    if os.environ.get("APPROVE"):
        page.write_text("\n".join(found) + "\n", encoding="utf-8")
    assert "\n".join(found) + "\n" == page.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        (["trigger.beta=-1"], ["--set trigger.beta = -1: should be greater than 0"]),
        (["network.loss={model='bernoulli'}"], ["--set network.loss.probability: missing "]),
        (["trigger.beta=-1", "nam=2"], ["--set trigger.beta = -1: ", "--set nam = 2: "]),
        (["trigger.beta=1"], ["FILE: name = 1: "]),  # the settings themselves are valid
        # The file alone is valid, but not with these settings.
        (["model.A=[[1]]"], ['FILE with --set model.A: model.name = "lane_following": ']),
        (
            ["horizon_s=3", 'network.loss.model="gilbert_elliott"', "network.mansd=9"],
            ["FILE with --set network.loss.model: network.loss.probability = 0.8: unknown key; "],
        ),
        (["mode=zoh", "observer.kind=kalman"], ["FILE with --set observer.kind: observer."]),
        (["trigger.beta"], ["--set trigger.beta: write it as key=value, e.g. trigger.beta=0.3"]),
        (["trigger.beta.x=1"], ["--set trigger.beta.x=1: trigger.beta is not a table"]),
        (['mode="zoh'], ["--set mode: not valid TOML: Unterminated string (at end of document)"]),
        (
            ["plant.initial_state.4=1"],
            ["--set plant.initial_state.4=1: plant.initial_state has the entries 0 to 3, not 4"],
        ),
    ],
)
def test_an_error_in_a_setting_is_not_attributed_to_the_file(
    settings: list[str], expected: list[str], tmp_path: Path
) -> None:
    name = "1" if expected[0].startswith("FILE: ") else '"lane"'
    text = LANE.replace('name = "lane"', f"name = {name}", 1)
    lines = mistakes_with(text, tmp_path, settings)
    assert len(lines) == len(expected)
    for line, begins in zip(lines, expected, strict=True):
        assert line.startswith(begins), line


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("name = \n", "Invalid value (at line 1, column 8)"),
        (
            "[trigger]\nbeta = 1\nnorm = '='\nbeta = 2\n",
            "line 4: trigger.beta is already defined in line 2",
        ),
        (
            "[model]\nA = [\n  [1.0],  # [\n]\nB = 1\nA = [\n  [2.0],\n]\n",
            "line 6: model.A is already defined in line 2",
        ),
        ("[trigger]\nbeta = 1\n[trigger]\n", "line 3: trigger is already defined in line 1"),
        (
            "[[loops]]\na = 1\n[[loops]]\na = 1\na = 2",
            "line 5: loops.a is already defined in line 4",
        ),
        ("loss = { model = 'a', model = 'b' }", "line 1: loss.model is defined twice"),
        ("x = [{ a = 1 },\n{ b = 1, b.c = 2 }]", "line 1: x is a table with a key twice"),
    ],
)
def test_invalid_toml_is_reported_with_its_line(text: str, says: str, tmp_path: Path) -> None:
    (line,) = mistakes_with(text, tmp_path, ())
    assert line.startswith("FILE: not valid TOML: ")
    assert says in line


def test_a_setting_names_an_entry_of_a_list(tmp_path: Path) -> None:
    path = tmp_path / "scenario.toml"
    path.write_text(LANE + '[[loops]]\nname = "a"\n[[loops]]\nname = "b"\n')
    found = load(path, ["plant.initial_state.2=0.5", "loops.1.mode=zoh", "loops.1.name=c"])
    assert found.plant.initial_state[2] == 0.5
    assert found.loops is not None
    assert [(one.name, one.mode) for one in found.loops] == [("a", None), ("c", "zoh")]
    with pytest.raises(CallerError, match=r"^--set loops\.1\.name = .a.: the name a is already"):
        load(path, ["loops.1.name=a"])


class Car:
    """A user's plant class; only its name is used."""


def test_a_class_is_given_by_its_file_and_name() -> None:
    with pytest.raises(CallerError, match="Car: a class is given by its file and its name: "):
        noack.load("double_integrator", {"plant.system": Car})


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_scenarios_are_unchanged_by_writing_and_reading(path: Path, tmp_path: Path) -> None:
    resolved = resolved_loops(load(path))
    copy = tmp_path / "copy.toml"
    for scenario in (load(path), *resolved):
        copy.write_text(dumps(scenario), encoding="utf-8")
        assert load(copy) == scenario
    assert resolve(load(copy)) == resolved[-1]
