"""`noack set`: its arguments, and the run that it applies to."""

import stat
from pathlib import Path
from typing import Any

import pytest
import tomli_w

from cosim.cli.execute_run import warn_of_other_runs
from cosim.cli.live_settings import parse_settings
from netem.core.errors import CallerError
from noack.runtime import active_runs
from noack.runtime.run_descriptor import RunDescriptor, new_access, new_descriptor
from noack.scenario.parameter_changes import changed
from noack.scenario.resolution import resolve
from noack.scenario.runtime_parameters import SHORT
from noack.scenario.scenario_file import load, validate
from tests.helpers.approved import compare_lines, lines_of_error


@pytest.fixture
def descriptor(content: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RunDescriptor:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    scenario = resolve(validate(content, "here"))
    return new_descriptor(new_access(tmp_path / "run", launched=True), scenario)


VALUES = {
    "loss": '{ model = "gilbert_elliott", mean_loss = 0.5, mean_burst = 3 }',
    "loss.p": "0.9",
    "mansd": "1",
    "constraints": '[{ kind = "at_most", losses = 1, window = 10 }]',
    "beta": "0.3",
    "alpha": "0.2",
    "floor": "0.01",
    "setpoint": "[3.0, 0.0]",
}
"""A value of each runtime parameter that has a short name."""


@pytest.mark.parametrize("short", VALUES)
def test_both_names_of_a_parameter_work_in_noack_set_in_the_option_and_in_changes(
    short: str, content: dict[str, Any], tmp_path: Path
) -> None:
    path, text, values = tmp_path / "some.toml", VALUES[short], []
    assert VALUES.keys() == SHORT.keys()
    path.write_text(tomli_w.dumps(content))
    for name in (short, SHORT[short]):
        settings = parse_settings([name, text])
        values.append(changed(load(path), settings))
        values.append(load(path, [f"{name}={text}"]))
        change = {"at_s": 0.5, "set": {name: settings[SHORT[short]]}}
        scheduled = validate(content | {"changes": [change]}, "here")
        values.append(changed(load(path), scheduled.changes[0].set))
    assert values[0] != load(path)
    assert values[1:] == values[:-1]


def test_a_mistake_in_the_words_gives_the_approved_line(descriptor: RunDescriptor) -> None:
    compare_lines(
        Path(__file__).with_name("set_mistakes.txt"),
        lambda line: lines_of_error(lambda: changed(descriptor.scenario, parse_settings(line.split()))),
    )


def test_a_run_is_found_by_its_session_its_directory_or_as_the_only_one(
    descriptor: RunDescriptor, capsys: pytest.CaptureFixture[str]
) -> None:
    second = new_access(Path("elsewhere"), launched=True)
    with active_runs.registered_run(second, "lab"):
        assert active_runs.find_run().run_dir == "elsewhere"
        warn_of_other_runs()
        assert "elsewhere is active, too" in capsys.readouterr().err
    with (
        active_runs.registered_run(second, "lab"),
        active_runs.registered_run(descriptor, None) as path,
    ):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700
        assert descriptor.key.hex() not in path.read_text()
        with pytest.raises(CallerError, match="several runs are active: "):
            active_runs.find_run()
        assert active_runs.find_run(session="lab").run_dir == "elsewhere"
        assert active_runs.find_run(run_dir=Path(descriptor.run_dir)).run_dir == descriptor.run_dir
        with pytest.raises(CallerError, match="no run is active in session 'none'; active: "):
            active_runs.find_run(session="none")
        with pytest.raises(CallerError, match="probability = nan: expected a finite number"):
            active_runs.request_change(active_runs.find_run(session="lab"), parse_settings(["loss.p", "nan"]))
    assert list(path.parent.iterdir()) == []
