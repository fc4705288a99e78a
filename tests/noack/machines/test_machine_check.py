"""noack_process_check refuses each wrong number that the steps would act on."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from noack.core.core_library import ffi
from noack.machines.loop_machines import LoopMachines
from tests.noack.machines.any_machines import (
    MS,
    Sizes,
    controller,
    observer,
    plant,
    sensor,
    set_number,
    text_of,
)
from tests.trigger_rules import TABLES

SOURCE = Path(__file__).parents[3] / "native" / "loop" / "machine_check.c"
NULL, FAR, HUGE = ffi.NULL, 2**60 + 1, 2**63 - 1
OF = Sizes(3, 2, 2, 2, 2, predictive=True, acknowledged=True, disturbed=(True, True))

PROCESS = "a process has no machines"
PERIOD = "a machine has a phase, a horizon or a period out of range"
NUMBERS = "a machine has numbers out of range"
RECEIVES = "a machine receives vectors of more than 64 entries"
MESSAGE_TIMES = "a machine receives messages of a time out of range"
MODEL = "a model has no matrices of its size"
PLACES = "a model's number of kept matrices is not a power of 2, from 4 on"
POINTS = "a model has no set points"
ORDER = "the set points of a model are not in the order of time"
SIGNAL = "a disturbance or a noise has another width than what it is added to"
PLANT = "a plant has no state"
PLANT_TIMES = "a plant has a timeout, a time or a number of measurements out of range"
RULE, RULE_TIMES = "a trigger rule has no matrix", "a trigger rule has times out of range"
OBSERVER = "an observer has no model"
INPUTS = "an observer receives measurements without the inputs applied"
COVARIANCE = "a Kalman filter has no covariances"
SENSOR = "a sensor has no state"
SENSOR_TIMES = "a sensor has a time or a number of events out of range"
ROOM = "a sensor with acknowledgements has no room for updates"
CONTROLLER = "a controller has no state"
CONTROLLER_TIMES = "a controller has a time or a newest update out of range"
ROW = "the rows of a table have another size than the machines write"
TABLE = "a table has no rows"

WRONG: dict[str, list[tuple[str, Any, str]]] = {
    "plant": [
        ("role", 3, "a process has no role or no loops"),
        ("role", -1, "a process has no role or no loops"),
        ("loops", 0, "a process has no role or no loops"),
        ("loops", 65_536, "a process has no role or no loops"),
        *[(name, NULL, PROCESS) for name in ("due_ns", "heap", "notes", "plants")],
        ("note_places", 0, PROCESS), ("note_count", -1, PROCESS), ("note_count", 257, PROCESS),
        *[(f"machine.{name}", value, "a machine has not 1 to 64 states and inputs")
          for name in "nm" for value in (0, 65, -HUGE)],
        *[(f"machine.{name}_ns", value, PERIOD)
          for name in ("phase", "horizon", "first", "period") for value in (-1, FAR)],
        *[(f"machine.{name}", value, NUMBERS)
          for name in ("step", "inputs", "first_number") for value in (-1, HUGE)],
        ("machine.step", 2**60 // (10 * MS) + 1, NUMBERS),
        ("machine.received.entries", -1, RECEIVES), ("machine.received.entries", 65, RECEIVES),
        ("machine.acknowledgements.entries", 1, RECEIVES),
        *[(f"machine.{name}.not_after_ns", value, MESSAGE_TIMES)
          for name in ("received", "acknowledgements") for value in (-1, 2**62)],
        *[("heap_count", value, "a process has more loops with a tick than it has loops")
          for value in (-1, 2)],
        ("machine.period_ns", 0, "a plant has no period"),
        ("input_period_ns", 0, "a plant has no period"),
        *[(name, value, "a plant has no measurement")
          for name, most in (("measure_every", 2**20), ("p", 64)) for value in (0, most + 1)],
        ("C", NULL, "a plant without C measures all states"),
        *[(name, value, "a plant has an unknown system or watchdog")
          for name in ("system", "watchdog") for value in (-1, 3)],
        *[(name, NULL, "a linear plant has no matrices") for name in ("Ad", "Bd")],
        *[("internal", value, "a plant's system has too many states of its own")
          for value in (-1, 763, HUGE)],
        *[(f"{name}.{field}", value, SIGNAL)
          for name, width in (("at_input", 2), ("at_state", 3), ("noise", 2))
          for field, value in (("width", width + 1), ("width", -1), ("rows", 0), ("rows", 65_537),
                               ("first", HUGE), ("first", -HUGE), ("values", NULL))],
        ("sources", 6, "a plant's input matrix has another number of columns than it has sources"),
        *[(name, value, "a plant receives actuations of another size")
          for name, value in (("predictions", 0), ("predictions", 65), ("predictions", 3),
                              ("carries_model", 0), ("machine.received.entries", 6))],
        ("measure_every", 32, "a measurement has more than 64 entries"),
        *[(name, value, PLANT_TIMES)
          for name, value in (("timeout_ns", -1), ("notice_ns", -1), ("newest_ns", -1),
                              ("newest_ns", 2**62 + 1), ("fallback_ns", -1), ("fallback_ns", HUGE),
                              ("measurements", -1), ("measurements", HUGE))],
        *[(name, NULL, PLANT)
          for name in ("x", "z", "u", "applied", "held", "inputs", "scratch", "x_c")],
        *[(name, NULL, "a watchdog that predicts has no model") for name in ("K", "x_fallback")],
        ("fallback.transitions", NULL, MODEL),
        *[(f"tables[{k}].{name}", value, ROW)
          for k in (0, 1) for name, value in (("row_bytes", 8), ("row_bytes", HUGE))],
        *[(f"tables[{k}].{name}", value, TABLE)
          for k in (0, 1) for name, value in (("rows", NULL), ("places", 0), ("places", HUGE),
                                              ("count", -1), ("count", 1025))],
    ],
    "sensor": [
        ("sensors", NULL, PROCESS),
        ("machine.period_ns", 10, "a sensor has ticks"),
        ("model.transitions.n", 2, MODEL),
        *[(f"model.transitions.{name}", NULL, MODEL)
          for name in ("H", "steps_ns", "matrices", "scratch")],
        *[("model.transitions.places", value, PLACES) for value in (0, 2, 12, 2**21, -8)],
        *[(f"model.{name}", value, POINTS)
          for name, value in (("changes", -1), ("changes", HUGE), ("has_point", NULL),
                              ("points", NULL), ("since_ns", NULL))],
        *[(f"model.since_ns[{k}]", value, ORDER)
          for k, value in ((0, -1), (0, 31 * MS), (1, 19 * MS), (1, 2**62 + 1))],
        *[(f"rule.{name}_rows", value, RULE)
          for name in ("up", "down", "gain_up", "gain_down") for value in (-1, 257, HUGE)],
        *[(f"rule.{name}", NULL, RULE) for name in ("up", "gain_up", "gain_down")],
        *[(f"rule.{name}_ns", value, RULE_TIMES)
          for name in ("grid", "shortest", "longest", "idle")
          for value in (FAR, -FAR if name == "idle" else -1)],
        *[("observer.kind", value, "an observer is of an unknown kind") for value in (-1, 3)],
        *[("observer.p", value, INPUTS) for value in (0, 1, 5, HUGE, -HUGE - 1)],
        *[(f"observer.{name}", NULL, OBSERVER)
          for name in ("Ad", "Bd", "C", "gain", "x", "scratch")],
        *[("observer.t_ns", value, "an observer has a time out of range") for value in (-2, HUGE)],
        *[(f"observer.{name}", NULL, COVARIANCE) for name in "PQR"],
        ("plant_period_ns", 0, "a sensor receives measurements of another size"),
        ("observer.kind", 0, "a sensor receives measurements of another size"),
        *[(name, NULL, SENSOR) for name in ("x_s", "event_x", "x", "e_s", "scratch")],
        *[(name, value, SENSOR_TIMES)
          for name in ("model_ns", "trigger.since_ns", "trigger.measured_ns", "events")
          for value in (-1, HUGE)],
        *[(name, value, ROOM)
          for name, value in (("sent_count", -1), ("sent_count", 65), ("sent_places", 0),
                              ("sent_places", HUGE), ("sent", NULL), ("sent_x", NULL),
                              ("timeout_ns", -1), ("timeout_ns", FAR))],
        *[(f"tables[{k}].row_bytes", 8, ROW) for k in (1, 2)],
    ],
    "controller": [
        ("controllers", NULL, PROCESS),
        *[(name, value, "a controller has no period, or receives updates of another size")
          for name, value in (("machine.period_ns", 0), ("machine.received.entries", 2))],
        *[("predictions", value, "an actuation has more than 64 entries")
          for value in (0, 31, 65, HUGE)],
        *[(name, NULL, CONTROLLER)
          for name in ("K", "safe_input", "x_c", "x", "u", "scratch", "x_r", "u_r")],
        *[(name, value, CONTROLLER_TIMES)
          for name, value in (("model_ns", -1), ("model_ns", HUGE), ("newest", -3))],
        ("model.transitions", NULL, MODEL),
    ],
}  # fmt: skip
CASES = [(role, *case) for role, cases in WRONG.items() for case in cases]
NOT_ACKNOWLEDGED = "a sensor waits for acknowledgements and has none"


def machines_of(role: str) -> LoopMachines:
    """A machine with as many parts as one can have."""
    if role == "plant":
        own = LoopMachines([plant(next(_full_plants()), OF)])
    elif role == "sensor":
        part = sensor(0, OF, form=list(TABLES).index("dynamic"))
        part.observer = observer(next(_kalman()), 2, 3, 2, 2, 1.0)
        own = LoopMachines([part])
        memory, one = own._memory, own.machines[0].model
        memory.set_model(one, one.transitions, [20 * MS, 30 * MS], [None, np.ones(3), None])
    else:
        own = LoopMachines([controller(next(_with_point()), OF)])
    assert text_of(own) is None
    return own


def _full_plants() -> Any:
    for seed in range(100):
        part = plant(seed, OF)
        assert part.measuring is not None
        if part.measuring.is_noisy and part.watchdog.is_predictive:
            yield seed


def _kalman() -> Any:
    for seed in range(100):
        found = observer(np.random.default_rng(seed), 2, 3, 2, 2, 1.0)
        if found.settings.kind == "kalman":
            yield np.random.default_rng(seed)


def _with_point() -> Any:
    return (seed for seed in range(100) if controller(seed, OF).setpoint is not None)


@pytest.mark.parametrize(("role", "path", "value", "text"), CASES)
def test_a_wrong_number_is_refused(role: str, path: str, value: Any, text: str) -> None:
    own = machines_of(role)
    set_number(own, path, value)
    assert text_of(own) == text


def test_a_sensor_that_waits_without_acknowledgements_is_refused() -> None:
    own = LoopMachines([sensor(0, Sizes(1, 1), form=0)])
    own.machines[0].sent_count = 1
    assert text_of(own) == NOT_ACKNOWLEDGED


def test_the_last_of_several_loops_is_checked_too() -> None:
    own = LoopMachines([controller(seed, Sizes(1, 1)) for seed in range(3)])
    assert text_of(own) is None
    own.machines[2].machine.m = 0
    assert text_of(own) == "a machine has not 1 to 64 states and inputs"


def test_python_is_told_what_is_wrong() -> None:
    with pytest.raises(ValueError, match=r"^controller: an actuation has more than 64 entries$"):
        LoopMachines([controller(1, OF._replace(predictions=31))])


def test_each_text_is_in_the_table() -> None:
    texts = re.findall(r'(?:return|:) "([^"]+)"', SOURCE.read_text())
    assert {text for *_, text in CASES} | {NOT_ACKNOWLEDGED} == {*texts}


@pytest.mark.parametrize("word", [-3, 11])
def test_a_layout_with_a_word_that_the_machine_does_not_write_is_refused(word: int) -> None:
    own = LoopMachines([controller(1, Sizes(1, 1)), controller(2, Sizes(3, 1))])
    assert text_of(own) is None
    own.core.tables[0].layouts[0][4] = word
    assert text_of(own) == "the rows of a table have another size than the machines write"
