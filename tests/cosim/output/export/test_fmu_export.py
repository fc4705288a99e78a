"""The FMUs of channel and controller, run by FMPy, against a simulated run of their scenario."""

import json
import math
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import noack
from cosim.output.export import export_scenario
from noack.core.errors import CallerError
from noack.protocol.record_tables import Fate
from noack.protocol.wire_format import Flow, Message
from noack.scenario.resolution import resolved_loops
from noack.scenario.scenario import Scenario
from tests.command_line import invoke
from tests.machine_parts import plant_of, sensor_of

fmpy = pytest.importorskip("fmpy", reason="the extra `fmi` is not installed")
from fmpy.fmi1 import FMICallException  # noqa: E402
from fmpy.fmi3 import FMU3Slave  # noqa: E402
from fmpy.validation import validate_fmu  # noqa: E402

BURSTS = {
    "horizon_s": 4.0,
    "network.mansd": 3,
    "network.loss": {"model": "gilbert_elliott", "good_to_bad": 0.4, "bad_to_good": 0.3},
    "network.impairments": [
        {"kind": "delay", "delay_s": 0.0055, "jitter_s": 0.004},
        {"kind": "duplicate", "probability": 0.3},
        {"kind": "corrupt", "probability": 0.1},
    ],
}
LOST = (Fate.DROPPED, Fate.CORRUPTED, Fate.OVERFLOWED, Fate.BLACKED_OUT)
PASSED = ("arrivals", "packet_number", "packet_sent_s", "packet_arrival_s", "packet_x")


H_S = 0.01
LOGS = list[list[str]]()
Folders = Callable[[Scenario], list[Path]]


class Fmu:
    """An instance that FMPy has made of an unzipped FMU."""

    def __init__(self, folder: Path) -> None:
        found = fmpy.read_model_description(folder)
        self.variables = {one.name: one for one in found.modelVariables}
        self.log = list[str]()
        LOGS.append(self.log)
        self.slave = FMU3Slave(
            instanceName="one", guid=found.guid, unzipDirectory=str(folder),
            modelIdentifier=found.coSimulation.modelIdentifier,
        )  # fmt: skip
        self.slave.instantiate(
            logMessage=lambda _env, _status, _kind, text: self.log.append(text.decode())
        )

    def start(self) -> "Fmu":
        self.slave.enterInitializationMode()
        self.slave.exitInitializationMode()
        return self

    def _method(self, verb: str, name: str) -> tuple[Any, int, int]:
        one = self.variables[name]
        count = int(np.prod([int(dimension.start) for dimension in one.dimensions]))
        return getattr(self.slave, f"{verb}{one.type}"), one.valueReference, count

    def get(self, name: str) -> Any:
        method, reference, count = self._method("get", name)
        found = method([reference], nValues=count)
        return found if self.variables[name].dimensions else found[0]

    def set(self, name: str, value: Any) -> None:
        method, reference, _ = self._method("set", name)
        method([reference], np.ravel(value).tolist())

    def step(self, t_s: float, h_s: float, **inputs: Any) -> None:
        for name, value in inputs.items():
            self.set(name, value)
        self.slave.doStep(t_s, h_s)

    def state(self) -> bytes:
        """A copy of its state, serialised."""
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
        files = export_scenario(scenario, tmp_path / "a.fmu", "fmu")
        assert [validate_fmu(str(file)) for file in files] == [[], []]
        return [Path(fmpy.extract(str(file), str(tmp_path / file.stem))) for file in files]

    return make


def only_message(outputs: Sequence[Any]) -> Message | None:
    return next((one for one in outputs if isinstance(one, Message)), None)


def co_simulated(scenario: Scenario, channel: Fmu, controller: Fmu) -> dict[str, Any]:
    """Run the loop of plant and sensor, which are the core's machines, with the two FMUs."""
    (resolved,) = resolved_loops(scenario)
    plant, sensor, h_ns = plant_of(resolved), sensor_of(resolved), resolved.timing.plant_period_ns
    x, u, events_ns = list[Any](), list[Any](), list[int]()
    last = resolved.timing.horizon_ns // h_ns
    for k in range(last + 100):  # at the end, what is in flight arrives
        t_ns, t_s, h_s = k * h_ns, k * h_ns / 1e9, h_ns / 1e9
        if k <= last:
            measured = only_message(plant.on_timer(t_ns))
            assert measured is not None
            x.append(measured.vector)
            update = only_message(sensor.handle(measured, t_ns))
            if update is not None:
                events_ns.append(t_ns)
                channel.set("x", update.vector)
        channel.step(t_s, h_s, send=len(events_ns))
        controller.step(t_s, h_s, **{name: channel.get(name) for name in PASSED})
        u.append(controller.get("u"))
        plant.handle(Message(Flow.ACTUATION, k, t_ns, np.array(u[-1])), t_ns)
    counts = {name: channel.get(name) for name in ("lost", "longest_burst", "arrivals")}
    counts["updates"] = controller.get("updates")
    return {"x": np.array(x), "u": np.array(u), "events_ns": events_ns} | counts


SLOW_TICKS = {
    "horizon_s": 6.0,
    "network.initial_sync": "known_state",
    "controller.rate_hz": 200.0,
}


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("lane_following", {"horizon_s": 6.0}),
        ("double_integrator", BURSTS),
        ("lane_constrained", SLOW_TICKS),
    ],
    ids=["plain", "bursts, delays, copies and damage", "constraints, a known start, slow ticks"],
)
def test_a_run_is_that_of_a_simulation(name: str, settings: Any, folders: Folders) -> None:
    """Bit for bit."""
    scenario = noack.load(name, settings)
    run = noack.simulate(scenario)
    channel, controller = (Fmu(folder).start() for folder in folders(scenario))
    found = co_simulated(scenario, channel, controller)
    packets = run.table("netem_packet").to_pydict()
    assert found["events_ns"] == packets["t_ns"]
    np.testing.assert_array_equal(found["x"], vectors(run, "plant_step", "x"))
    assert found["lost"] == sum(fate in LOST for fate in packets["fate"])
    assert found["longest_burst"] == max(packets["consecutive_losses"]) > 0
    assert found["updates"] == len(run.table("controller_delivery"))
    ticks = run.table("controller_step").to_pydict()["t_ns"]
    last = {t_ns // scenario.timing.plant_period_ns: row for row, t_ns in enumerate(ticks)}
    expected = vectors(run, "controller_step", "u")[[*last.values()]]
    np.testing.assert_array_equal(found["u"][[*last]], expected)


def vectors(run: Any, table: str, name: str) -> Any:
    """A vector of a table's rows, (rows, entries)."""
    found = run.table(table)
    names = [one for one in found.column_names if re.fullmatch(rf"{name}_\d+", one)]
    return np.transpose([found[one].to_numpy() for one in names])


def sent(channel: Fmu, steps: range) -> list[list[float]]:
    """Send a packet in each step; return what has arrived after each."""
    found = []
    for k in steps:
        channel.step(k * H_S, H_S, send=k + 1, x=[k, -k])
        found.append([channel.get("arrivals"), channel.get("received"), *channel.get("packet_x")])
    return found


def test_instances_are_separate_and_can_begin_or_go_on_again(folders: Folders) -> None:
    folder, other = folders(noack.load("double_integrator", BURSTS))
    one, two = Fmu(folder).start(), Fmu(folder).start()
    whole = sent(one, range(60))
    assert len({tuple(row) for row in whole}) > 20
    first = sent(two, range(30))  # while the other one exists
    kept = two.state()
    assert first + sent(two, range(30, 60)) == whole
    two.set_state(kept)
    assert sent(two, range(30, 60)) == whole[30:]
    one.set_state(kept)  # another instance's
    assert one.state() == kept
    assert sent(one, range(30, 60)) == whole[30:]
    one.slave.reset()
    assert sent(one.start(), range(60)) == whole
    controller = Fmu(other).start()
    for content in (controller.state(), kept[:-1], kept[:-1] + b"?"):
        assert "the state is not one of this FMU" in two.refuses(two.set_state, content)
    for instance in (one, two, controller):
        instance.slave.freeInstance()


def test_what_is_called_at_the_wrong_time_is_an_error(folders: Folders) -> None:
    channel, controller = map(Fmu, folders(noack.load("double_integrator", BURSTS)))
    slave = channel.slave
    assert "DoStep must not be called now" in channel.refuses(slave.doStep, 0.0, H_S)
    assert "must not be called now" in channel.refuses(slave.exitInitializationMode)
    start_later = (slave.fmi3EnterInitializationMode, slave.component, False, 0.0, 1.0, False, 0.0)
    assert "the start time must be 0" in channel.refuses(*start_later)
    channel.start()
    assert "must not be called now" in channel.refuses(slave.enterInitializationMode)
    for method, *given in (
        (slave.setFloat64, [99], [1.0]), (slave.setFloat64, [1], [1.0]),
        (slave.setInt64, [3], [1]), (slave.getFloat64, [14]), (slave.getFloat64, [2]),
        (slave.getFloat64, [2], 3),
    ):  # fmt: skip
        assert "value" in channel.refuses(method, *given)
    with pytest.raises(FMICallException, match="status 3"):
        slave.getFloat32([0])
    channel.step(0.0, H_S)
    for from_s, step_s, words in (
        (0.0, H_S, "forward"), (H_S, -H_S, "forward"), (math.nan, H_S, "forward"),
        (H_S, math.inf, "forward"), (2 * H_S, H_S, "begins where"),
    ):  # fmt: skip
        kept = channel.state()
        assert words in channel.refuses(slave.doStep, from_s, step_s)
        assert "must not be called now" in channel.refuses(slave.doStep, H_S, H_S)
        channel.set_state(kept)
    channel.set("send", 2)
    assert "`send` must be" in channel.refuses(slave.doStep, H_S, H_S)
    slave.reset()
    channel.start()
    for k in range(40):
        channel.step(k * 1e-4, 1e-4, send=k + 1)
    assert "make shorter steps" in channel.refuses(slave.doStep, 40e-4, 1.0)
    controller.start().set("arrivals", 9)
    assert "make shorter steps" in controller.refuses(controller.slave.doStep, 0.0, H_S)
    slave.reset()
    channel.start().slave.terminate()
    assert channel.get("arrivals") == 0
    assert "must not be called now" in channel.refuses(slave.doStep, 0.0, H_S)


def test_packets_that_no_run_has_are_not_used(folders: Folders) -> None:
    controller = Fmu(folders(noack.load("double_integrator"))[1]).start()
    for k, (number, sent_s, x) in enumerate(
        [(-1, 0.0, 1.0), (0, math.nan, 1.0), (0, -1.0, 1.0), (0, 1e300, 1.0), (0, 0.0, math.inf),
         (5, 0.0, 1.0), (5, 0.0, 2.0), (4, 0.0, 2.0)]
    ):  # fmt: skip
        packets = np.zeros((8, 3))
        packets[0] = number, sent_s, x
        controller.step(
            k * 1e-3, 1e-3, arrivals=k + 1, packet_number=packets[:, 0].astype(int),
            packet_sent_s=packets[:, 1], packet_x=np.repeat(packets[:, 2], 2),
        )  # fmt: skip
        assert controller.get("updates") == (k >= 5)
    assert np.isfinite(controller.get("x_c")).all()


def test_resources_that_are_damaged_give_one_line(folders: Folders) -> None:
    folder, other = folders(noack.load("double_integrator"))
    path = folder / "resources/noack.bin"
    content = path.read_bytes()
    for wrong, line in (
        (content[:-1], "noack.bin is too short"),
        (content[:40], "noack.bin is too short"),
        (content[:-1] + b"?", "noack.bin is damaged: its check sum is wrong"),
        (content[:16] + b"?" + content[17:], "for another version of noack than the library"),
        ((other / "resources/noack.bin").read_bytes(), "its token is another one"),
        (None, "noack.bin cannot be read"),
    ):
        path.unlink(missing_ok=True)
        if wrong is not None:
            path.write_bytes(wrong)
        with pytest.raises(Exception, match="Failed to instantiate"):
            Fmu(folder)
        (found,) = LOGS[-1]
        assert line in found


@pytest.mark.parametrize(
    ("name", "settings", "line"),
    [
        ("model_predictive", {}, 'controller.kind = "python": needs Python'),
        ("shared_bottleneck", {}, "the scenario has loops"),
        ("double_integrator", {"network.protocol": "ack"}, 'set protocol = "none"'),
        ("lane_actuation_loss", {}, "network.actuation: an FMU's channel"),
    ],
)
def test_a_scenario_that_an_fmu_cannot_have_is_one_line(
    name: str, settings: Any, line: str, tmp_path: Path
) -> None:
    scenario = noack.load(name, settings)
    with pytest.raises(CallerError, match=re.escape(line)) as raised:
        export_scenario(scenario, tmp_path / "a.fmu", "fmu")
    assert "\n" not in str(raised.value)
    assert not [*tmp_path.iterdir()]


def test_the_command_takes_scenarios_and_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A scenario gives the same bytes in each process: there is no address in them."""
    monkeypatch.chdir(tmp_path)
    scenario = noack.load("double_integrator", {"network.mansd": 2})
    expected = [path.read_bytes() for path in export_scenario(scenario, Path("a.fmu"), "fmu")]
    command = [sys.executable, "-m", "cosim.cli", "export", "double_integrator", "--format", "fmu"]
    subprocess.run([*command, "--set", "network.mansd=2"], check=True, capture_output=True)
    names = [f"double_integrator_{role}.fmu" for role in ("channel", "controller")]
    assert [len(Path(name).read_bytes()) for name in names] == [*map(len, expected)]
    run = noack.simulate(scenario, runs="runs")
    assert run.export("a.fmu") == [Path("a_channel.fmu"), Path("a_controller.fmu")]
    assert [path.read_bytes() for path in run.export("a.fmu")] == expected
    found = invoke("export", str(run.directory), "--format", "fmu", "--json")
    assert [Path(name).read_bytes() for name in json.loads(found.stdout)["files"]] == expected
    assert [Path(name).read_bytes() for name in names] == expected
    refused = invoke("export", str(run.directory), "--format", "csv", "--set", "network.mansd=2")
    assert refused.exit_code == 2
    assert "--set: a run has its settings" in refused.stderr
