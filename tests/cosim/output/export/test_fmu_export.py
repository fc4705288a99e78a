"""The FMUs of channel and controller, run by FMPy, against a simulated run of their scenario."""

import json
import math
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import noack
from cosim.output.export.fmu_export import write_scenario
from noack.core.errors import CallerError
from noack.protocol.record_tables import Fate
from noack.protocol.wire_format import Flow, Message
from noack.scenario.resolution import resolved_loops
from noack.scenario.scenario import Scenario
from tests.helpers.command_line import invoke
from tests.helpers.machine_parts import plant_of, sensor_of

fmpy = pytest.importorskip("fmpy", reason="the extra `fmi` is not installed")
from fmpy.fmi1 import FMICallException  # noqa: E402
from fmpy.fmi3 import FMU3Slave  # noqa: E402
from fmpy.validation import validate_fmu  # noqa: E402

BURSTS: dict[str, Any] = {
    "horizon_s": 3.0,
    "network.mansd": 3,
    "network.loss": {"model": "gilbert_elliott", "good_to_bad": 0.4, "bad_to_good": 0.3},
    "network.impairments": [
        {"kind": "delay", "delay_s": 0.0055, "jitter_s": 0.004},
        {"kind": "duplicate", "probability": 0.3},
        {"kind": "corrupt", "probability": 0.1},
    ],
}
SLOW_TICKS = {"network.initial_sync": "known_state", "controller.rate_hz": 200.0, "horizon_s": 6.0}
LOST = (Fate.DROPPED, Fate.CORRUPTED, Fate.OVERFLOWED, Fate.BLACKED_OUT)
PASSED = ("arrivals", "packet_number", "packet_sent_s", "packet_arrival_s", "packet_x")
H_S = 0.01
LOGS = list[list[str]]()
"""Of all instances."""
Folders = Callable[[Scenario], list[Path]]


class Fmu:
    """An instance that FMPy has made of an unzipped FMU."""

    def __init__(self, folder: Path) -> None:
        description = fmpy.read_model_description(folder)
        self.variables = {variable.name: variable for variable in description.modelVariables}
        self.log = list[str]()
        LOGS.append(self.log)
        name = description.coSimulation.modelIdentifier
        self.slave = FMU3Slave("", guid=description.guid, unzipDirectory=folder, modelIdentifier=name)
        self.slave.instantiate(logMessage=lambda *given: self.log.append(given[-1].decode()))

    def start(self) -> "Fmu":
        self.slave.enterInitializationMode()
        self.slave.exitInitializationMode()
        return self

    def get(self, name: str) -> Any:
        variable = self.variables[name]
        count = math.prod(int(dimension.start) for dimension in variable.dimensions)
        values = getattr(self.slave, f"get{variable.type}")([variable.valueReference], nValues=count)
        return values if variable.dimensions else values[0]

    def set(self, name: str, value: Any) -> None:
        variable = self.variables[name]
        getattr(self.slave, f"set{variable.type}")([variable.valueReference], np.ravel(value).tolist())

    def step(self, t_s: float, h_s: float, **inputs: Any) -> None:
        for name, value in inputs.items():
            self.set(name, value)
        self.slave.doStep(t_s, h_s)

    def follow(self, channel: "Fmu", t_s: float, h_s: float) -> Any:
        """A step of the controller after the channel; its u."""
        self.step(t_s, h_s, **{name: channel.get(name) for name in PASSED})
        return self.get("u")

    def state(self) -> bytes:
        state = self.slave.getFMUState()
        content: bytes = self.slave.serializeFMUState(state)
        self.slave.freeFMUState(state)
        return content

    def set_state(self, content: bytes) -> None:
        state = self.slave.deserializeFMUState(content)
        self.slave.setFMUState(state)
        self.slave.freeFMUState(state)

    def refuses(self, method: Callable[..., object], *given: object) -> str:
        """The one line that is logged for a call that fails."""
        self.log.clear()
        with pytest.raises(FMICallException, match="status 3"):
            method(*given)
        (line,) = self.log
        return line


@pytest.fixture
def folders(tmp_path: Path) -> Folders:
    """Writes the FMUs of a scenario, and unzips them: folders of channel and controller."""

    def make(scenario: Scenario) -> list[Path]:
        files = write_scenario(scenario, tmp_path / "a.fmu")
        assert [validate_fmu(str(file)) for file in files] == [[], []]
        return [Path(fmpy.extract(str(file), str(tmp_path / file.stem))) for file in files]

    return make


def vectors(run: Any, table: str, name: str) -> Any:
    """A vector of a table's rows, (rows, entries)."""
    columns = run.table(table)
    names = [column for column in columns.column_names if re.fullmatch(rf"{name}_\d+", column)]
    return np.transpose([columns[column].to_numpy() for column in names])


@pytest.mark.parametrize(
    ("name", "settings"),
    [("lane_following", {"horizon_s": 6.0}),
     pytest.param("double_integrator", BURSTS, marks=pytest.mark.sanitized),
     ("lane_constrained", SLOW_TICKS)],
    ids=["plain", "bursts, delays, copies and damage", "constraints, a known start, slow ticks"],
)  # fmt: skip
def test_a_run_is_that_of_a_simulation(name: str, settings: Any, folders: Folders) -> None:
    """Bit for bit; plant and sensor are the core's machines."""
    scenario = noack.load(name, settings)
    run, (resolved,) = noack.simulate(scenario), resolved_loops(scenario)
    channel, controller = (Fmu(folder).start() for folder in folders(scenario))
    plant, sensor, h_ns = plant_of(resolved), sensor_of(resolved), resolved.timing.plant_period_ns
    x, u, events_ns, last = [], [], [], resolved.timing.horizon_ns // h_ns
    for k in range(last + 100):  # at the end, what is in flight arrives
        t_ns, t_s, h_s = k * h_ns, k * h_ns / 1e9, h_ns / 1e9
        if k <= last:
            measured = next(output for output in plant.on_timer(t_ns) if isinstance(output, Message))
            x.append(measured.vector)
            for update in sensor.handle(measured, t_ns):
                if isinstance(update, Message):
                    events_ns.append(t_ns)
                    channel.set("x", update.vector)
        channel.step(t_s, h_s, send=len(events_ns))
        u.append(controller.follow(channel, t_s, h_s))
        plant.handle(Message(Flow.ACTUATION, k, t_ns, np.array(u[-1])), t_ns)
    packets = run.table("netem_packet").to_pydict()
    assert events_ns == packets["t_ns"]
    np.testing.assert_array_equal(x, vectors(run, "plant_step", "x"))
    assert channel.get("lost") == sum(fate in LOST for fate in packets["fate"])
    assert channel.get("longest_burst") == max(packets["consecutive_losses"]) > 0
    assert controller.get("updates") == len(run.table("controller_delivery"))
    ticks = run.table("controller_step").to_pydict()["t_ns"]
    rows = {t_ns // h_ns: row for row, t_ns in enumerate(ticks)}  # the last tick of each step
    expected = vectors(run, "controller_step", "u")[[*rows.values()]]
    np.testing.assert_array_equal(np.array(u)[[*rows]], expected)


@pytest.mark.sanitized
def test_steps_may_have_any_length(folders: Folders) -> None:
    """A channel with steps ten times as long gives the controller packets ahead of their time."""
    first, second = folders(noack.load("double_integrator", BURSTS))
    short, long, short_controller, long_controller = (
        Fmu(folder).start() for folder in (first, first, second, second)
    )
    u = list[tuple[Any, Any]]()
    for k in range(400):
        number, t_s, h_s = k // 10 + 1, k * H_S / 10, H_S / 10
        if k % 10 == 0:
            long.step(t_s, H_S, send=number, x=[number, 1.0])
        short.step(t_s, h_s, send=number, x=[number, 1.0])
        u.append((short_controller.follow(short, t_s, h_s), long_controller.follow(long, t_s, h_s)))
    assert all(left == right for left, right in u)
    assert long.get("arrivals") == short.get("arrivals") == long_controller.get("arrivals") > 10


def sent(channel: Fmu, steps: range) -> list[list[float]]:
    """Send a packet in each step; return what has arrived after each."""
    outputs = []
    for k in steps:
        channel.step(k * H_S, H_S, send=k + 1, x=[k, -k])
        outputs.append([channel.get("arrivals"), channel.get("received"), *channel.get("packet_x")])
    return outputs


@pytest.mark.sanitized
def test_instances_are_separate_and_can_begin_or_go_on_again(folders: Folders) -> None:
    folder, other = folders(noack.load("double_integrator", BURSTS))
    first, second = Fmu(folder).start(), Fmu(folder).start()
    whole = sent(first, range(60))
    assert len({tuple(row) for row in whole}) > 20
    assert sent(second, range(30)) == whole[:30]  # while the other one exists
    state = second.state()
    assert sent(second, range(30, 60)) == whole[30:]
    for instance in (first, second):
        instance.set_state(state)
        assert instance.state() == state
        assert sent(instance, range(30, 60)) == whole[30:]
    first.slave.reset()
    assert sent(first.start(), range(60)) == whole
    controller = Fmu(other).start()
    for content in (controller.state(), state[:-1], state[:-1] + b"?"):
        assert "the state is not one of this FMU" in second.refuses(second.set_state, content)
    for instance in (first, second, controller):
        instance.slave.freeInstance()


@pytest.mark.sanitized
def test_what_is_called_at_the_wrong_time_is_an_error(folders: Folders) -> None:
    channel, controller = map(Fmu, folders(noack.load("double_integrator", BURSTS)))
    slave, now = channel.slave, "must not be called now"
    assert now in channel.refuses(slave.doStep, 0.0, H_S)
    assert now in channel.refuses(slave.exitInitializationMode)
    start_later = (slave.fmi3EnterInitializationMode, slave.component, False, 0.0, 1.0, False, 0.0)
    assert "the start time must be 0" in channel.refuses(*start_later)
    channel.start()
    assert now in channel.refuses(slave.enterInitializationMode)
    get, put = slave.getFloat64, slave.setFloat64
    for wrong in ((put, [99], [1.0]), (put, [1], [1.0]), (put, [5], [1.0]), (get, [14]), (get, [2]),
                  (get, [2], 3)):  # fmt: skip
        assert "value" in channel.refuses(*wrong)
    assert "fmi3GetFloat32 is not a function" in channel.refuses(slave.getFloat32, [0])
    no_state = (slave.fmi3SetFMUState, slave.component, None)
    assert "there is no state" in channel.refuses(*no_state)
    channel.step(0.0, H_S)
    state = channel.state()
    for from_s, step_s in ((0.0, H_S), (H_S, -H_S), (math.nan, H_S), (H_S, math.inf), (0.5, H_S)):
        assert "a step" in channel.refuses(slave.doStep, from_s, step_s)
        assert now in channel.refuses(slave.doStep, H_S, H_S)
        channel.set_state(state)
    channel.set("send", 2)
    assert "`send` must be" in channel.refuses(slave.doStep, H_S, H_S)
    slave.reset()
    channel.start()
    for k in range(40):
        channel.step(k * 1e-4, 1e-4, send=k + 1)
    assert "make shorter steps" in channel.refuses(slave.doStep, 40e-4, 1.0)
    for arrivals, arrival_s, line in ((9, 0.0, "make shorter steps"), (-1, 0.0, "not decrease"),
                                      (1, math.nan, "not a time")):  # fmt: skip
        controller.start().set("arrivals", arrivals)
        controller.set("packet_arrival_s", [arrival_s, *[0.0] * 7])
        assert line in controller.refuses(controller.slave.doStep, 0.0, H_S)
        controller.slave.reset()
    slave.reset()
    channel.start().slave.terminate()
    assert channel.get("arrivals") == 0
    assert now in channel.refuses(slave.doStep, 0.0, H_S)


@pytest.mark.sanitized
def test_packets_that_no_run_has_are_not_used(folders: Folders) -> None:
    controller = Fmu(folders(noack.load("double_integrator"))[1]).start()
    wrong = (
        (-1, 0.0, 1.0),
        (0, math.nan, 1.0),
        (0, -1.0, 1.0),
        (0, 1e300, 1.0),
        (0, 0.0, math.inf),
    )
    for k, packet in enumerate([*wrong, (5, 0.0, 1.0), (5, 0.0, 2.0), (4, 0.0, 2.0)]):
        number, sent_s, x = ([value, *[0] * 7] for value in packet)
        inputs = {"packet_number": number, "packet_sent_s": sent_s}
        controller.step(k * H_S, H_S, arrivals=k + 1, packet_x=np.repeat(x, 2), **inputs)
        assert controller.get("updates") == (k >= len(wrong))
    assert np.isfinite(controller.get("x_c")).all()


@pytest.mark.sanitized
def test_resources_that_are_damaged_give_one_line(folders: Folders) -> None:
    folder, other = folders(noack.load("double_integrator"))
    path = folder / "resources/noack.bin"
    content = path.read_bytes()
    for wrong, line in (
        (content[:-1], "noack.bin is too short"),
        (content[:40], "noack.bin is too short"),
        (content + b"?", "noack.bin is too long"),
        (content[:-1] + b"?", "noack.bin is damaged: its check sum is wrong"),
        (content[:16] + b"?" + content[17:], "for another version of noack than the library"),
        ((other / "resources/noack.bin").read_bytes(), "their tokens differ"),
        (None, "noack.bin cannot be read"),
    ):
        path.unlink(missing_ok=True)
        if wrong is not None:
            path.write_bytes(wrong)
        with pytest.raises(Exception, match="Failed to instantiate"):
            Fmu(folder)
        (logged,) = LOGS[-1]
        assert line in logged


def test_the_command_takes_scenarios_and_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A scenario gives the same bytes in each process: there is no address in them."""
    monkeypatch.chdir(tmp_path)
    scenario = noack.load("double_integrator", {"network.mansd": 2})
    expected = [path.read_bytes() for path in write_scenario(scenario, Path("a.fmu"))]
    command = ("export", "double_integrator", "--format", "fmu", "--set", "network.mansd=2")
    subprocess.run([sys.executable, "-m", "cosim.cli", *command], check=True, capture_output=True)
    names = [f"double_integrator_{role}.fmu" for role in ("channel", "controller")]
    assert [Path(name).read_bytes() for name in names] == expected
    run = noack.simulate(scenario, runs="runs")
    result = invoke("export", str(run.directory), "--format", "fmu", "--out", "b.fmu", "--json")
    for files in (run.export("c.fmu"), map(Path, json.loads(result.stdout)["files"])):
        assert [path.read_bytes() for path in files] == expected
    loops = noack.simulate(noack.load("different_loops", {"horizon_s": 0.1}))
    with pytest.raises(CallerError, match="the scenario has loops"):
        next(iter(loops.loops.values())).export("d.fmu")
    for option, kind in ("--set=network.mansd=2", "csv"), ("--no-certificates", "fmu"):
        result = invoke("export", str(run.directory), "--format", kind, option)
        assert result.exit_code == 2
        assert f"{option.split('=')[0]}: " in result.stderr
    Path("v1.2").mkdir()
    invoke("export", "double_integrator", "--format", "fmu", "--out", "v1.2")
    invoke("export", "double_integrator", "--format", "fmu", "--out", "v1.2/v1.2")
    names = [path.name.removesuffix("_channel.fmu") for path in Path("v1.2").glob("*_channel.fmu")]
    assert sorted(names) == ["double_integrator", "v1.2"]
