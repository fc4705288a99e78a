"""A run is explained by its model, and a record or scenario that differs in anything is not."""

from collections.abc import Callable, Mapping
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from cosim.record.run_record import Rows, RunRecord
from cosim.simulation.virtual_time import simulate_loops
from netem.core.packet_rows import Fate
from noack.protocol.record_tables import NO_SEQUENCE
from noack.scenario.resolution import resolve_run
from noack.theory.certificates.conditions import ideal_conditions
from tests.cosim.record.changed_records import changed, copied
from tests.helpers.shipped import resolved, shipped
from tests.oracles.explained_run.explain import explains
from tests.oracles.explained_run.findings import SCHEDULE

Change = Callable[[Mapping[str, Rows]], None]
_SINE = "{kind='sine',at='state',amplitude=[0.0,0.0,0.1,0.1],hz=2.0}"
_SETTINGS = (
    "horizon_s=1.6", "trigger.beta=0.01",
    "network.actuation={loss={model='bernoulli',probability=0.3},mansd=2}",
    "controller.predictions=3", "network.impairments=[{kind='delay',delay_s=0.004,jitter_s=0.003}]",
    f"plant.disturbances=[{{kind='uniform',bound=[0.01,0.01]}},{_SINE}]",
    "controller.setpoint=[0.0,0.0,0.0,1.0]",
)  # fmt: skip


@cache
def _record(*settings: str) -> RunRecord:
    return simulate_loops(resolve_run(shipped("lane_following", *(settings or _SETTINGS)))).record(0)


def _number(rows: Rows, column: str, place: int, amount: float) -> None:
    rows[column][place] += amount


def _events(tables: Mapping[str, Rows]) -> NDArray[np.int64]:
    return np.flatnonzero(tables["sensor_measurement"]["event"] != NO_SEQUENCE)


def _omit_event(tables: Mapping[str, Rows]) -> None:
    rows, place = tables["sensor_measurement"], _events(tables)[5]
    rows["event"][place] = NO_SEQUENCE


def _early_event(tables: Mapping[str, Rows]) -> None:
    rows, place = tables["sensor_measurement"], _events(tables)[5]
    rows["event"][place - 1] = rows["event"][place]


def _one_loss_more(tables: Mapping[str, Rows]) -> None:
    rows = tables["netem_packet"]
    updates = np.flatnonzero(rows["flow"] == 0)
    rows["fate"][updates[3:9]] = Fate.DROPPED


def _later_update(tables: Mapping[str, Rows]) -> None:
    rows = tables["controller_delivery"]
    rows["input"][3] += 40
    ticks = tables["controller_step"]
    ticks["input"][(ticks["input"] > rows["input"][3] - 40) & (ticks["input"] <= rows["input"][3])] -= 1


CHANGES: Mapping[str, Change] = {
    "a state of the plant": lambda t: _number(t["plant_step"], "x", 700, 1e-6),
    "a step's time": lambda t: _number(t["plant_step"], "t_ns", 700, 3),
    "x(0)": lambda t: _number(t["plant_step"], "x", 0, 1e-6),
    "a disturbance": lambda t: _number(t["plant_step"], "d", 700, 0.05),
    "an applied input": lambda t: _number(t["plant_step"], "u", 700, 1e-6),
    "the actuation that is applied": lambda t: _number(t["plant_step"], "actuation", 700, -1),
    "the predicted input that is applied": lambda t: _number(t["plant_step"], "entry", 700, 1),
    "a measurement": lambda t: _number(t["sensor_measurement"], "x", 700, 1e-6),
    "a measurement's time": lambda t: _number(t["sensor_measurement"], "t_ns", 700, 3),
    "the sensor's model": lambda t: _number(t["sensor_measurement"], "x_s", 700, 1e-6),
    "an event that is missing": _omit_event,
    "an event that is early": _early_event,
    "too many losses": _one_loss_more,
    "an update's state": lambda t: _number(t["controller_delivery"], "x", 3, 1e-6),
    "a reset": lambda t: _number(t["controller_delivery"], "x_c", 3, 1e-6),
    "an update that acts late": _later_update,
    "the controller's model": lambda t: _number(t["controller_step"], "x_c", 700, 1e-6),
    "a computed input": lambda t: _number(t["controller_step"], "u", 700, 1e-6),
    "an input received": lambda t: _number(t["plant_actuation"], "u", 300, 1e-6),
    "a predicted input": lambda t: _number(t["plant_actuation"], "predicted", 300, 1e-6),
    "a tick's time": lambda t: _number(t["controller_step"], "t_ns", 700, 3),
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_changed_record_is_not_explained(name: str) -> None:
    tables = copied(_record())
    CHANGES[name](tables)
    assert explains(changed(_record(), tables)), name


def test_the_record_itself_is_explained() -> None:
    assert explains(_record()) == []
    assert len(_record()["controller_delivery"]) > 5


@pytest.mark.deep
@pytest.mark.parametrize(
    "setting",
    [
        "model.parameters.a12=10.4",
        "model.gain=[[0,0,-1.001,0.025],[0,0,-1.001,0.025]]",
        "plant.uncertainty_A=[[0.11,0.1,0,0],[0.1,0.1,0,0],[0,0,0,0],[0,0,0,0]]",
        "plant.initial_state=[0.5,0,0.1,3.001]",
        "plant.rate_hz=499",
        "plant.measure_every=2",
        f"plant.disturbances=[{{kind='uniform',bound=[0.001,0.001]}},{_SINE}]",
        "trigger.beta=0.0101",
        "trigger.alpha_per_s=0.26",
        "trigger.weight=[[1.01,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]",
        "network.mansd=3",
        "network.constraints=[{kind='at_most',losses=3,window=6}]",
        "network.constraints=[{kind='recovery',deliveries=3}]",
        "controller.rate_hz=450",
        "controller.phase=0.4",
        "controller.setpoint=[0.0,0.0,0.0,0.9]",
        "controller.safe_input=[0.1,0.0]",
        'mode="zoh"',
        "seeds.plant=2",
    ],
)
def test_another_scenario_does_not_explain_the_record(setting: str) -> None:
    other = resolved("lane_following", *_SETTINGS, setting)
    assert explains(changed(_record(), scenario=other))


def test_times_beyond_the_schedule_are_told_apart() -> None:
    """A live run has such findings where the machine was late."""
    settings = ("horizon_s=2", "trigger.beta=0.05", "certificate.late_periods=0")
    record = _record(*settings, "network.impairments=[{kind='delay',delay_s=0.012}]")
    assert explains(record) == []
    findings = explains(changed(record, scenario=resolved("lane_following", *settings)))
    assert findings
    assert {finding.part for finding in findings} == {SCHEDULE}
    assert explains(record, ideal_conditions(record.scenario))


@pytest.mark.parametrize(
    ("policy", "other"),
    [
        ("{policy='relative',sigma=0.1}", "{policy='relative',sigma=0.101}"),
        ("{policy='mixed',sigma=0.1,epsilon=0.05}", "{policy='mixed',sigma=0.1,epsilon=0.051}"),
        ("{policy='absolute',delta=0.1}", "{policy='absolute',delta=0.101}"),
        ("{policy='periodic',period_s=0.1}", "{policy='periodic',period_s=0.102}"),
        ("{policy='lyapunov',rate_per_s=0.7}", "{policy='lyapunov',rate_per_s=0.5}"),
        ("{policy='send_on_area',delta_s=0.01}", "{policy='send_on_area',delta_s=0.0101}"),
        (
            "{policy='deadline',interval_s=0.5,rule={policy='absolute',delta=0.5}}",
            "{policy='deadline',interval_s=0.51,rule={policy='absolute',delta=0.5}}",
        ),
        (
            "{policy='dwell',interval_s=0.1,rule={policy='absolute',delta=0.001}}",
            "{policy='dwell',interval_s=0.102,rule={policy='absolute',delta=0.001}}",
        ),
        (
            "{policy='self_triggered',beta=0.5,alpha_per_s=0.2,growth_per_s=1.0,mismatch_per_s=1.0,"
            "shortest_s=0.02,longest_s=1.0}",
            "{policy='self_triggered',beta=0.5,alpha_per_s=0.2,growth_per_s=1.5,mismatch_per_s=1.0,"
            "shortest_s=0.02,longest_s=1.0}",
        ),
    ],
)
def test_events_are_those_of_the_rule(policy: str, other: str) -> None:
    settings = ("horizon_s=3", "network.mansd=1")
    record = _record(*settings, f"trigger={policy}")
    assert len(record.events()) > 2
    assert explains(record) == []
    findings = explains(changed(record, scenario=resolved("lane_following", *settings, f"trigger={other}")))
    assert any(finding.part == "trigger" for finding in findings)


def test_events_follow_the_dynamic_variable() -> None:
    name, settings = "tabuada_dynamic", ("horizon_s=4",)
    record = simulate_loops(resolve_run(shipped(name, *settings))).record(0)
    assert explains(record) == []
    other = resolved(name, *settings, f"trigger.decay_per_s={record.scenario.trigger.decay_per_s + 0.1}")
    assert any(finding.part == "trigger" for finding in explains(changed(record, scenario=other)))


def test_it_covers_the_run_up_to_the_first_change() -> None:
    changes = "changes=[{at_s=1.0,set={'trigger.beta'=0.3}},{at_s=1.5,set={'network.mansd'=0}}]"
    record = _record("horizon_s=3", changes)
    assert explains(record) == []
    early, late = copied(record), copied(record)
    early["plant_step"]["x"][400] += 1e-6
    late["plant_step"]["x"][600] += 1e-6
    assert explains(changed(record, early))
    assert not explains(changed(record, late))


def test_a_run_that_diverges_is_explained_up_to_its_first_extreme_number() -> None:
    """Numbers that overflow are not sent: inputs and updates then stay away."""
    gain = "model.gain=[[200.0,100.0]]"
    scenario = shipped("double_integrator", "horizon_s=12", gain, "model.allow_unstable=true")
    record = simulate_loops(resolve_run(scenario)).record(0)
    assert not np.isfinite(record["plant_step"]["x"][-1]).all()
    assert explains(record) == []
    tables = copied(record)
    tables["plant_step"]["x"][20] += 1e-3
    assert explains(changed(record, tables))


def test_a_watchdog_may_replace_inputs_where_actuations_may_be_lost() -> None:
    """Its timeout is shorter than three lost actuations take: no finding, and no bound."""
    lost = 'network.actuation={mansd=4,loss={model="bernoulli",probability=0.5}}'
    watchdog = 'plant.watchdog={policy="zero",timeout_s=0.003}'
    scenario = shipped("double_integrator", lost, watchdog, "horizon_s=2.0")
    record = simulate_loops(resolve_run(scenario)).record(0)
    replaced = (record["plant_step"]["u"] == 0).all(axis=1)
    assert replaced[10:].any()
    assert not explains(record)
