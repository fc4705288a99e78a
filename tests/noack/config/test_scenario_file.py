"""Every mistake in a scenario gives one line: file, key, value, and the remedy."""

import json
import math
import re
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st

from noack.config.resolution import resolve, resolved_loops
from noack.config.scenario import Scenario
from noack.config.scenario_file import dumps, load, put, validate, value_of
from noack.core.errors import CallerError

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


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (tmp_path / "some.toml").write_text(LANE)
    return tmp_path / "some.toml"


def mistakes(text: str, folder: Path, lines: Sequence[str] = ()) -> list[str]:
    """The error message for a scenario file with these ``key=value`` settings added."""
    content = tomllib.loads(text)
    for line in lines:
        key, _, value = line.partition("=")
        put(content, key, value_of(value, key), key)
    return mistakes_with(tomli_w.dumps(content), folder, ())


def mistakes_with(text: str, folder: Path, settings: Sequence[str]) -> list[str]:
    """The error message for these settings, with the file's name shortened to FILE."""
    path = folder / "some.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(CallerError) as caught:
        resolve(load(path, settings))
    return str(caught.value).replace(str(path), "FILE").split("\n")


@pytest.mark.parametrize("text", [LANE, DOUBLE], ids=["lane", "double"])
def test_the_scenarios_are_valid_before_mistakes_are_added(text: str, tmp_path: Path) -> None:
    (tmp_path / "some.toml").write_text(text)
    resolve(load(tmp_path / "some.toml"))


# One setting each that makes LANE invalid: how its line begins after the file name, and what the
# remedy must contain.
# fmt: off
LANE_MISTAKES = [
    # Unknown keys, at every level.
    ("sped=2", "sped = 2: unknown key; ", "did you mean speed?"),
    ("xyzzy=2", "xyzzy = 2: unknown key; ", "the keys here are certificate, .*, trigger"),
    ("pland.rate_hz=9", 'pland = {"rate_hz": 9}: unknown key; ', "did you mean plant?"),
    ("network.loss.p=0.5", "network.loss.p = 0.5: unknown key; ", "model, probability"),
    ("ports.recorder=9", "ports.recorder = 9: unknown key; ", "controller, netem, plant, sensor"),
    ("model.parameters.a13=1", "model.parameters.a13 = 1: ", "a11, a12, a21, a22, b1, b2"),
    # Types.
    ("horizon_s=20 s", 'horizon_s = "20 s": ', "should be a valid number"),
    ("trigger.beta=[1]", "trigger.beta = [1]: ", "should be a valid number"),
    ("network.mansd=4.0", "network.mansd = 4.0: ", "should be a valid integer"),
    ("network.enforce_mansd=0", "network.enforce_mansd = 0: ", "should be a valid boolean"),
    ('plant.initial_state=[1,2,"x",4]', 'plant.initial_state.2 = "x": ', "a valid number"),
    ("plant.initial_state=[1,2,3,true]", "plant.initial_state.3 = true: ", "valid number"),
    ('model.parameters.a11="x"', 'model.parameters.a11 = "x": ', "should be a valid number"),
    ("trigger=3", "trigger = 3: ", "table|object"),
    ("network.loss=bernoulli", 'network.loss = "bernoulli": ', "table|object"),
    ("trigger.weight=[]", "trigger.weight = []: ", "at least (1|one)"),
    ("trigger.weight=[[1],[true]]", "trigger.weight.1.0 = true: ", "should be a valid number"),
    # Choices.
    ("mode=modl", 'mode = "modl": ', "should be 'model' or 'zoh'"),
    ("trigger.policy=decayin", 'trigger.policy = "decayin": ', "did you mean decaying?"),
    ("network.loss.model=bernouli", 'network.loss.model = "bernouli": ', "did you mean bernoulli?"),
    ("network.loss={}", "network.loss.model: missing; ", "one of .*bernoulli"),
    # Impairments are a list of tables, each chosen by its kind, with a loss model within a loss.
    ("network.impairments=[3]", "network.impairments.0 = 3: ", 'e.g. { kind = "corrupt", '),
    ("network.impairments=[{}]", "network.impairments.0.kind: missing; ",
     "one of blackout, corrupt"),
    ('network.impairments=[{kind="dely"}]',
     'network.impairments.0.kind = "dely": must be one of blackout, ', "did you mean delay?"),
    ('network.impairments=[{kind="delay",delay_ms=5}]',
     "network.impairments.0.delay_ms = 5: unknown key; ", "did you mean delay_s?"),
    ('network.impairments=[{kind="delay",distribution="empirical",samples_s=[0.1]}]',
     "network.impairments.0.samples_s = [0.1]: ", "needs at least 2 entries"),
    ('network.impairments=[{kind="rate"}]', "network.impairments.0.rate_bps: missing ",
     r"\(bits per second\)"),
    ('network.impairments=[{kind="loss"}]', "network.impairments.0.loss: missing ", "loss model"),
    ('network.impairments=[{kind="loss",loss="x"}]',
     'network.impairments.0.loss = "x": should be a table, ',
     'e.g. { model = "bernoulli", probability = ... }'),
    ('network.impairments=[{kind="duplicate",probability=0},{kind="loss",loss={model="x"}}]',
     'network.impairments.1.loss.model = "x": ', "must be one of bernoulli, four_state"),
    ('network={mansd=1,loss={model="worst_case"},impairments=[{kind="delay",loss_correlation=1}]}',
     "network.impairments.0.loss_correlation = 1: ",
     "needs a loss before it, by model bernoulli or gilbert_elliott"),
    ("name=../../etc", 'name = "../../etc": ', "letters"),
    # Ranges.
    ("horizon_s=0", "horizon_s = 0: ", "should be greater than 0"),
    ("horizon_s=0.001", "horizon_s = 0.001: ", r"one plant step \(0.002 s\)"),
    ("horizon_s=1e8", "horizon_s = 100000000.0: ", "less than or equal to 1e7|10000000"),
    ("network.mansd=-1", "network.mansd = -1: ", "greater than or equal to 0"),
    ("plant.rate_hz=5e-324", "plant.rate_hz = 5e-324: ", "greater than or equal to 0.000001"),
    ("controller.rate_hz=1e-9", "controller.rate_hz = 1e-09: ", "greater than or equal to"),
    ("plant.watchdog.timeout_s=0.001", "plant.watchdog.timeout_s = 0.001: ",
     "shorter than a period of the controller .0.002 s."),
    ("controller.phase=1", "controller.phase = 1: ", "should be less than 1"),
    ("controller.safe_input=[1.0]", "controller.safe_input = [1.0]: ",
     "expected 2 entries .one per input., found 1"),
    ("seeds.loss=18446744073709551616", "seeds.loss = 18446744073709551616: ", "less than"),
    ("ports.netem=47001", "ports.netem = 47001: ", "already given to plant"),
    # Values that are not finite numbers.
    ("horizon_s=nan", "horizon_s = NaN: ", "finite|greater than 0"),
    ("plant.initial_state=[1,2,3,inf]", "plant.initial_state.3 = Infinity: ", "finite"),
    ("trigger.weight=[[nan]]", "trigger.weight.0.0 = NaN: ", "finite"),
    # Rates with a period that is not a whole number of nanoseconds; the remedy is a valid rate.
    ("plant.rate_hz=300", "plant.rate_hz = 300: ", r"whole .* 300\.000030000003"),
    ("controller.rate_hz=60", "controller.rate_hz = 60: ", r"whole .* 59\.9999988"),
    # Shapes that depend on both model and plant.
    ("plant.initial_state=[1,2,3]", "plant.initial_state = [1, 2, 3]: ", "4 entries.*found 3"),
    ("plant.initial_state_halfwidth=[1,2]", "plant.initial_state_halfwidth = [1, 2]: ",
     "4 entries.*found 2"),
    ("plant.initial_state_halfwidth=[1,2,3,-1]", "plant.initial_state_halfwidth = [1, 2, 3, -1]: ",
     "half-widths cannot be negative"),
    ("plant.uncertainty_A=[[1,2],[3,4]]", "plant.uncertainty_A = [[1, 2], [3, 4]]: ",
     "expected 4 x 4 .*found 2 x 2"),
    ("plant.uncertainty_B=[[1],[2],[3],[4]]", "plant.uncertainty_B = [[1], [2], [3], [4]]: ",
     "expected 4 x 2 .*found 4 x 1"),
    ("trigger.weight=[[1,0],[0,1]]", "trigger.weight = [[1, 0], [0, 1]]: ",
     "expected 4 x 4 .*found 2 x 2"),
    ("trigger.weight=[[1,0,0,0],[0,1,0,0],[0,0,1,0],[1,1,1,0]]",
     "trigger.weight = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [1, 1, 1, 0]]: ",
     "W must be invertible"),
    ("model.gain=[[1,2,3,4]]", "model.gain = [[1, 2, 3, 4]]: ", "expected 2 x 4 .*found 1 x 4"),
    ('model.state_names=["a"]', 'model.state_names = ["a"]: ', "expected 4 entries .*, found 1"),
    # Combinations of settings.
    ("plant.draw=given", "plant.A: ", 'draw = "given" needs both matrices A and B'),
    ("plant.A=[[1]]", "plant.A = [[1]]: ", 'matrices are for draw = "given", not .*"uniform"'),
    ("model.A=[[1]]", 'model.name = "lane_following": ', "give one or the other"),
    # A gain that does not stabilise.
    ("model.parameters.gain=-1.0", 'model.parameters = {"gain": -1.0}: ', "u = -K x does: give -K"),
    ("model.gain=[[0,0,0,0],[0,0,0,0]]", "model.gain = ", "all eigenvalues of A . BK have neg"),
    # Values that the named model cannot use.
    ("model.parameters.look_ahead=0", "model.parameters.look_ahead = 0: ", "zero|0"),
]
# The same for DOUBLE, which gives its model by matrices.
DOUBLE_MISTAKES = [
    ("model.A=[[0,1]]", "model.A = [[0, 1]]: ", "1 x 1 .*square.*found 1 x 2"),
    ("model.A=[[0,1],[0]]", "model.A = [[0, 1], [0]]: ", r"same length, found lengths \[1, 2\]"),
    ("model.B=[[0]]", "model.B = [[0]]: ", r"expected 2 x 1 \(one row per state\), found 1 x 1"),
    ("model.gain=[[1],[1]]", "model.gain = [[1], [1]]: ", "expected 1 x 2 .*found 2 x 1"),
    ("model.gain=[[1,1.5]]", "model.gain = [[1, 1.5]]: ",
     "real part 2 /s; u = -K x does: give -K"),
    ("model.gain=[[0,-1.5]]", "model.gain = [[0, -1.5]]: ",
     "real part 0 /s.*allow_unstable = true"),
    ("model={A=[[-1,0],[0,-1]],B=[[1e200],[1]],gain=[[1e200,0]]}",
     "model.gain = [[1e+200, 0]]: ", "infinite entries; check the units"),
    ("model.parameters.a=1", 'model.parameters = {"a": 1}: ', "only a named model has parameters"),
    ("model={}", "model.A: ", r"missing: A, B, gain"),
    ("model={A=[[0]],B=[[1]]}", "model.gain: ", r"missing: gain"),
    ("plant.draw=uniform", "plant.uncertainty_A: ", "needs uncertainty_A or uncertainty_B"),
    ('plant={draw="given",A=[[1]],B=[[1],[1]],initial_state=[1,0]}', "plant.A = [[1]]: ",
     "expected 2 x 2 .*found 1 x 1"),
    ('plant={draw="given",A=[[1,0],[0,1]],B=[[1]],initial_state=[1,0]}', "plant.B = [[1]]: ",
     "expected 2 x 1 .*found 1 x 1"),
]
# Only the keys of the chosen loss model are suggested.
LOSS_MISTAKES = [
    ('network.loss={model="bernoulli",probability=0.3,good_to_bad=0.1}',
     "network.loss.good_to_bad = 0.1: unknown key; ", "^[^_]*$"),
    ('network.loss={model="lossless",probability=0.3}',
     "network.loss.probability = 0.3: unknown key; ", "^the keys here are model$"),
    ('network.loss={model="worst_case",x=1}', "network.loss.x = 1: unknown key; ",
     "^the keys here are model$"),
    ('network.loss={model="bernoulli"}', "network.loss.probability: missing ", r"^\([^_]*$"),
]
# fmt: on


def assert_line(lines: list[str], begins: str, remedy: str) -> None:
    (line,) = lines
    assert line.startswith(f"FILE: {begins}"), line
    assert re.search(remedy, line.removeprefix(f"FILE: {begins}")), line


@pytest.mark.parametrize(
    ("text", "setting", "begins", "remedy"),
    [
        *((LANE, *mistake) for mistake in LANE_MISTAKES + LOSS_MISTAKES),
        *((DOUBLE, *mistake) for mistake in DOUBLE_MISTAKES),
    ],
    ids=[mistake[0] for mistake in LANE_MISTAKES + LOSS_MISTAKES + DOUBLE_MISTAKES],
)
def test_a_mistake_gets_one_line(
    text: str, setting: str, begins: str, remedy: str, tmp_path: Path
) -> None:
    assert_line(mistakes(text, tmp_path, [setting]), begins, remedy)


@pytest.mark.parametrize(
    ("key", "begins"),
    [
        ("name", "names the run's directory"),
        ("model", "the model that"),
        ("trigger.beta", ""),
        ("network.mansd", "M − 1, the "),
        ("network.loss", "loss of updates, "),
    ],
)
def test_a_missing_key_is_named_with_its_purpose(
    content: Content, key: str, begins: str, tmp_path: Path
) -> None:
    section, _, last = key.rpartition(".")
    del (content[section] if section else content)[last]
    (line,) = mistakes(tomli_w.dumps(content), tmp_path)
    assert re.fullmatch(rf"FILE: {re.escape(key)}: missing \({begins}.{{10,}}\)", line)


def test_every_mistake_gets_its_own_line(tmp_path: Path) -> None:
    settings = ["mode=x", "plant.rate=1", "trigger.beta=-1", "network.loss.probability=2"]
    lines = mistakes(LANE, tmp_path, settings)
    assert [line.partition(" = ")[0] for line in lines] == [
        "FILE: mode",
        "FILE: plant.rate",
        "FILE: trigger.beta",
        "FILE: network.loss.probability",
    ]


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        (["trigger.beta=-1"], ["--set trigger.beta = -1: should be greater than 0"]),
        (["network.loss={model='bernoulli'}"], ["--set network.loss.probability: missing "]),
        (["trigger.bet=1"], ["--set trigger.bet = 1: unknown key; did you mean beta?"]),
        (["plant.initial_state=[1,2]"], ["--set plant.initial_state = [1, 2]: "]),
        (["trigger.beta=-1", "nam=2"], ["--set trigger.beta = -1: ", "--set nam = 2: "]),
        (["trigger.beta=1"], ["FILE: name = 1: "]),  # the settings themselves are valid
        # The file alone is valid, but not with these settings.
        (["model.A=[[1]]"], ['FILE with --set model.A: model.name = "lane_following": ']),
        (
            ["horizon_s=3", 'network.loss.model="gilbert_elliott"', "network.mansd=9"],
            ["FILE with --set network.loss.model: network.loss.probability = 0.8: unknown key; "],
        ),
        (["mode=zoh", "observer.kind=kalman"], ["FILE with --set observer.kind: observer."]),
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


def test_an_empty_file_reports_every_required_key(tmp_path: Path) -> None:
    required = ["name", "horizon_s", "model", "plant", "trigger", "network"]
    assert [line.split(": ")[1] for line in mistakes("", tmp_path)] == required


def test_a_long_value_is_shortened(tmp_path: Path) -> None:
    (line,) = mistakes(LANE, tmp_path, [f'mode="{"x" * 500}"'])
    assert len(line) < 200
    assert "xxx..." in line
    assert "should be 'model' or 'zoh'" in line


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("name = \n", "Invalid value (at line 1, column 8)"),
        ("name = 'a'\nname = 'b'", "line 2: name is already defined in line 1"),
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
        ("seeds.loss = 1\n[seeds]\nloss = 2", "line 2: seeds is already defined in line 1"),
        ("loss = { model = 'a', model = 'b' }", "line 1: loss.model is defined twice"),
        ("x = [{ a = 1 },\n{ b = 1, b.c = 2 }]", "line 1: x is a table with a key twice"),
        ("[plant\n", "line 1"),
        ("just words", "line 1"),
    ],
)
def test_invalid_toml_is_reported_with_its_line(text: str, says: str, tmp_path: Path) -> None:
    (line,) = mistakes_with(text, tmp_path, ())
    assert line.startswith("FILE: not valid TOML: ")
    assert says in line


def test_a_missing_file_is_reported_with_a_similar_one_beside_it(tmp_path: Path) -> None:
    (tmp_path / "lane.toml").write_text(LANE)
    with pytest.raises(CallerError) as caught:
        load(tmp_path / "lan.toml")
    near = f"did you mean {tmp_path}/lane.toml?"
    assert str(caught.value) == f"{tmp_path}/lan.toml: no such file; {near}"
    for other in (tmp_path / "nowhere" / "lan.toml", tmp_path / "other.toml"):
        with pytest.raises(CallerError) as caught:
            load(other)
        assert str(caught.value) == f"{other}: no such file"


def test_an_unreadable_file_is_reported(tmp_path: Path) -> None:
    (tmp_path / "bytes.toml").write_bytes(b"name = '\xff'")
    for path in (tmp_path, tmp_path / "bytes.toml"):
        with pytest.raises(CallerError, match=r"^[^\n]*: cannot be read: [^\n]*$"):
            load(path)


@pytest.mark.parametrize(
    ("setting", "read"),
    [
        ("trigger.beta=0.3", lambda s: s.trigger.beta == 0.3),
        (" trigger.beta = 0.3 ", lambda s: s.trigger.beta == 0.3),
        ("mode=zoh", lambda s: s.mode == "zoh"),
        ('mode="zoh"', lambda s: s.mode == "zoh"),
        ("description=a = b", lambda s: s.description == "a = b"),
        ("plant.initial_state=[1, 2, 3, 4]", lambda s: s.plant.initial_state == (1, 2, 3, 4)),
        ('network.loss={model="worst_case"}', lambda s: s.network.loss.model == "worst_case"),
        ("seeds.loss=7", lambda s: s.seeds.loss == 7),  # in a table that is missing from the file
        ("realtime.enabled=false", lambda s: not s.realtime.enabled),
    ],
)
def test_settings_replace_values_of_the_file(
    setting: str, read: Callable[[Scenario], bool], path: Path
) -> None:
    assert not read(load(path))
    changed = load(path, [setting])
    assert read(changed)
    assert changed.ports == load(path).ports  # all other settings are unchanged


def test_a_setting_names_an_entry_of_a_list(tmp_path: Path) -> None:
    path = tmp_path / "scenario.toml"
    path.write_text(LANE + '[[loops]]\nname = "a"\n[[loops]]\nname = "b"\n')
    found = load(path, ["plant.initial_state.2=0.5", "loops.1.mode=zoh", "loops.1.name=c"])
    assert found.plant.initial_state[2] == 0.5
    assert found.loops is not None
    assert [(one.name, one.mode) for one in found.loops] == [("a", None), ("c", "zoh")]
    with pytest.raises(CallerError, match=r"^--set loops\.1\.name = .a.: the name a is already"):
        load(path, ["loops.1.name=a"])


def test_the_last_setting_of_a_key_wins(path: Path) -> None:
    assert load(path, ["speed=2", "speed=3"]).speed == 3


@pytest.mark.parametrize(
    ("setting", "says"),
    [
        ("trigger.beta", "--set trigger.beta: write it as key=value, e.g. trigger.beta=0.3"),
        (" =3", "--set  =3: write it as key=value, e.g. trigger.beta=0.3"),
        ("trigger.beta.x=1", "--set trigger.beta.x=1: trigger.beta is not a table"),
        ("plant.initial_state=[1,2",
         "--set plant.initial_state: not valid TOML: Unclosed array (at end of document)"),
        ('mode="zoh', "--set mode: not valid TOML: Unterminated string (at end of document)"),
        ("plant.initial_state.4=1",
         "--set plant.initial_state.4=1: plant.initial_state has the entries 0 to 3, not 4"),
        ("plant.initial_state.x=1",
         "--set plant.initial_state.x=1: plant.initial_state has the entries 0 to 3, not x"),
    ],
)  # fmt: skip
def test_a_setting_that_cannot_be_applied_is_reported(
    setting: str, says: str, tmp_path: Path
) -> None:
    assert mistakes_with(LANE, tmp_path, [setting]) == [says]


def test_the_message_quotes_only_the_name_of_the_source(content: Content) -> None:
    content["speed"] = -1
    with pytest.raises(CallerError, match=r"^run 7/scenario\.toml: speed = -1: "):
        validate(content, "run 7/scenario.toml")


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_scenarios_are_unchanged_by_writing_and_reading(path: Path, tmp_path: Path) -> None:
    resolved = resolved_loops(load(path))
    copy = tmp_path / "copy.toml"
    for scenario in (load(path), *resolved):
        copy.write_text(dumps(scenario), encoding="utf-8")
        assert load(copy) == scenario
    assert resolve(load(copy)) == resolved[-1]


LOSSES = [
    {"model": "worst_case"},
    {"model": "bernoulli", "probability": 1 / 3},
    {"model": "gilbert_elliott", "good_to_bad": 0.1, "bad_to_good": 0.7},
]
numbers = st.floats(-1e3, 1e3)  # a step with larger values may overflow to infinity


@st.composite
def contents(draw: st.DrawFn) -> Content:
    n, m = draw(st.integers(1, 4)), draw(st.integers(1, 2))

    def rows(r: int, c: int, entries: st.SearchStrategy[float] = numbers) -> list[list[float]]:
        row = st.lists(entries, min_size=c, max_size=c)
        return draw(st.lists(row, min_size=r, max_size=r))

    plant: Content = {"draw": draw(st.sampled_from(["nominal", "uniform", "vertex", "given"]))}
    if plant["draw"] == "given":
        plant |= {"A": rows(n, n), "B": rows(n, m)}
    else:
        plant |= {
            "uncertainty_A": rows(n, n, st.floats(0, 1e3)),
            "uncertainty_B": rows(n, m, st.floats(0, 1)),
        }
    plant["initial_state"] = rows(1, n)[0]
    return {
        "name": draw(st.from_regex(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}", fullmatch=True)),
        "description": draw(st.text(st.characters(codec="utf-8"))),
        "mode": draw(st.sampled_from(["model", "zoh"])),
        "horizon_s": draw(st.floats(0.01, 1e7)),
        "speed": draw(st.floats(1e-6, 1000)),
        "model": {
            "A": rows(n, n),
            "B": rows(n, m),
            "gain": rows(m, n, st.floats(-1, 1)),
            "allow_unstable": True,
            "state_names": [draw(st.text(st.characters(codec="utf-8"))) for _ in range(n)],
        },
        "plant": plant,
        "trigger": {
            "beta": draw(st.floats(5e-324, 1e300)),
            "alpha_per_s": draw(st.floats(1e-9, 1e9)),
            "weight": [[2.0 * (i == j) for j in range(n)] for i in range(n)],
        },
        "network": {
            "mansd": draw(st.integers(0, 1_000_000)),
            "loss": draw(st.sampled_from(LOSSES)),
        },
        "seeds": {"plant": draw(st.integers(0, 2**64 - 1))},
    }


@given(contents())
def test_any_scenario_survives_being_resolved_written_and_read(content: Content) -> None:
    scenario = validate(content, "here")
    resolved = resolve(scenario)
    for one in (scenario, resolved):
        text = dumps(one)
        assert validate(tomllib.loads(text), "there") == one
    assert resolve(resolved) == resolved
    assert math.isfinite(sum(resolved.plant.initial_state))
    assert json.loads(resolved.model_dump_json()) == resolved.model_dump(mode="json")
