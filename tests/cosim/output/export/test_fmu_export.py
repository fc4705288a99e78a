"""The FMUs of channel and controller, run by FMPy, against a simulated run of their scenario."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import noack
from cosim.output.export import export_scenario
from noack.protocol.record_tables import Fate
from noack.protocol.wire_format import Flow, Message
from noack.scenario.resolution import resolved_loops
from noack.scenario.scenario import Scenario
from tests.machine_parts import plant_of, sensor_of

fmpy = pytest.importorskip("fmpy", reason="the extra `fmi` is not installed")
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
PASSED = ("arrivals", "packet_number", "packet_sent", "packet_arrival", "packet_x")


Folders = Callable[[Scenario], list[Path]]


class Fmu:
    """An instance that FMPy has made of an unzipped FMU."""

    def __init__(self, folder: Path) -> None:
        found = fmpy.read_model_description(folder)
        self.variables = {one.name: one for one in found.modelVariables}
        self.log: list[str] = []
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

    def close(self) -> None:
        self.slave.freeInstance()


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
