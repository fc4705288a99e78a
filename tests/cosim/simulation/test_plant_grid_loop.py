"""The loop on the plant's grid, against single exponentials and against the machines of runs."""

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from cosim.analysis.fidelity import recorded_loop
from cosim.record.run_record import RunRecord
from cosim.simulation.continuous import ContinuousLoop
from cosim.simulation.plant_grid_loop import PlantGridLoop, PlantGridRun, StepSchedule
from cosim.simulation.virtual_time import simulate
from noack.core.linear_systems import Matrix
from noack.protocol.record_tables import PLANT_STEP
from noack.scenario.resolution import policy_of, resolve
from noack.scenario.scenario_file import validate
from tests.oracles.random_scenarios import POLICIES, random_scenario


def simulated(number: int) -> RunRecord:
    """A random scenario without what the loop on the plant's grid does not have."""
    content: dict[str, Any] = random_scenario(number)
    for section, keys in (
        (content, ("observer", "changes")),
        (content["plant"], ("disturbances", "measurement", "watchdog")),
        (content["network"], ("protocol", "acknowledgements", "actuation")),
        (content["controller"], ("setpoint", "safe_input", "predictions", "update_timeout_s")),
    ):
        for key in keys:
            section.pop(key, None)
    return simulate(resolve(validate(content, "random")))


def is_known(record: RunRecord) -> bool:
    return record.scenario.network.initial_sync == "known_state"


def on_the_grid(record: RunRecord, schedule: StepSchedule, *, delay: bool, hold: bool) -> PlantGridRun:
    system = ContinuousLoop(record.loop, policy_of(record.scenario))
    loop = PlantGridLoop(system, schedule, known_start=is_known(record))
    return loop.run(delay=delay, hold=hold)


def step_by_step(record: RunRecord, schedule: StepSchedule, *, delay: bool) -> tuple[Matrix, list[int]]:
    """x at each step and the events of the decaying rule, one exponential at a time."""
    loop, n, trigger = record.loop, record.loop.n, record.scenario.decaying
    W = np.eye(n) if loop.weight is None else loop.weight
    both = np.block([[loop.A, loop.B @ loop.K], [np.zeros((n, n)), loop.H]])

    @lru_cache(None)
    def transition(dt_ns: int) -> Matrix:
        return np.asarray(expm(both * (dt_ns * 1e-9)))

    x_s, common = loop.x0, is_known(record)
    z = np.concatenate([loop.x0, loop.x0 if common else 0 * loop.x0])
    in_flight: list[tuple[int, int, int, Any]] = []
    newest, events, states = -1, [], []
    for step, is_measured in enumerate(schedule.measured):
        now_ns = step * schedule.period_ns
        states.append(z[:n])
        error = float(np.linalg.norm(W @ (x_s - z[:n])))
        level = max(trigger.beta * np.exp(-trigger.alpha_per_s * now_ns * 1e-9), trigger.floor)
        if is_measured and (not common or error > level):
            x_s, common = z[:n], True
            if schedule.delivered(len(events)):
                wait_ns = schedule.delay_ns(len(events)) if delay else 0
                in_flight.append((now_ns + wait_ns, len(events), now_ns, z[:n]))
            events.append(step)
        at_ns = now_ns
        for acts_ns, number, event_ns, x in sorted(in_flight, key=lambda entry: entry[:2]):
            if acts_ns >= now_ns + schedule.period_ns:
                continue
            z = transition(acts_ns - at_ns) @ z
            at_ns = acts_ns
            if number > newest:
                newest = number
                z = np.concatenate([z[:n], transition(acts_ns - event_ns)[n:, n:] @ x])
            in_flight = [entry for entry in in_flight if entry[1] != number]
        z = transition(now_ns + schedule.period_ns - at_ns) @ z
        x_s = transition(schedule.period_ns)[n:, n:] @ x_s
    return np.array(states), events


@pytest.mark.parametrize("delay", [False, True])
def test_the_plant_grid_loop_is_what_one_exponential_after_another_gives(delay: bool) -> None:
    for number in range(POLICIES.index("decaying"), 120, len(POLICIES)):
        record = simulated(number)
        full_schedule = recorded_loop(record).schedule
        late_schedule = replace(
            full_schedule, measured=full_schedule.measured & (np.arange(len(full_schedule.measured)) > 3)
        )
        for schedule in (full_schedule, late_schedule):
            grid_run = on_the_grid(record, schedule, delay=delay, hold=False)
            expected, events = step_by_step(record, schedule, delay=delay)
            assert grid_run.event_steps.tolist() == events
            # Products, each with an error of about 1e-16 of the state, which may grow.
            size = np.abs(expected).max()
            np.testing.assert_allclose(grid_run.x, expected, rtol=0, atol=1e-12 * size)


@pytest.mark.parametrize("first", range(len(POLICIES)))
def test_the_plant_grid_loop_with_all_effects_is_what_the_machines_do(first: int) -> None:
    """Losses, delays, reordering, all kinds of rates and phases."""
    for number in range(first, 4 * len(POLICIES), len(POLICIES)):
        record = simulated(number)
        live = recorded_loop(record)
        grid_run = on_the_grid(record, live.schedule, delay=True, hold=True)
        expected = record[PLANT_STEP]["x"][: len(grid_run.x)]
        np.testing.assert_allclose(grid_run.x, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
        period_s = record.scenario.timing.plant_period_ns * 1e-9
        np.testing.assert_allclose(grid_run.event_steps * period_s, live.event_s, rtol=1e-12)
