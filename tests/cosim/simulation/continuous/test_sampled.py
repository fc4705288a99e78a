"""The loop on the plant's grid, against step-by-step exponentials and against the machines."""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from cosim.analysis.fidelity import live_run
from cosim.simulation.continuous import ContinuousLoop
from cosim.simulation.plant_grid_loop import PlantGridLoop, StepSchedule
from cosim.simulation.virtual_time import simulate
from noack.core.linear_systems import Matrix
from noack.protocol.record_tables import PLANT_STEP
from noack.scenario.resolution import LoopMatrices, policy_of, resolve
from noack.scenario.scenario_file import validate
from noack.trigger.trigger_rule import TriggerRule
from tests.oracles.random_scenarios import POLICIES, random_scenario
from tests.trigger_rules import decaying_rule

PERIOD_NS = 10_000_000
STEPS = 200


class Case(NamedTuple):
    """A random loop and schedule."""

    loop: LoopMatrices
    trigger: TriggerRule
    measured: list[bool]
    lost: list[bool]
    delays_ns: list[int]
    known: bool

    def delivered(self, event: int) -> bool:
        return not self.lost[event % len(self.lost)]

    def delay_ns(self, event: int) -> int:
        return self.delays_ns[event % len(self.delays_ns)]

    def schedule(self) -> StepSchedule:
        never = np.full(STEPS + 1, -1)
        measured = np.array(self.measured)
        return StepSchedule(
            PERIOD_NS, measured, self.delivered, self.delay_ns, self.delay_ns, never
        )

    def sampled(self, *, delay: bool) -> tuple[Matrix, list[int]]:
        loop = PlantGridLoop(
            ContinuousLoop(self.loop, self.trigger), self.schedule(), known_start=self.known
        )
        run = loop.run(delay=delay, hold=False)
        return run.x, run.event_steps.tolist()

    def naive(self, *, delay: bool) -> tuple[Matrix, list[int]]:
        """x at each step and the events, one exponential at a time."""
        loop, n = self.loop, self.loop.n
        both = np.block([[loop.A, loop.B @ loop.K], [np.zeros((n, n)), loop.H]])

        @lru_cache(None)
        def transition(dt_ns: int) -> Matrix:
            return np.asarray(expm(both * (dt_ns * 1e-9)))

        z = np.concatenate([loop.x0, loop.x0 if self.known else 0 * loop.x0])
        x_s, common = loop.x0, self.known
        in_flight: list[tuple[int, int, int, Any]] = []
        newest, events, states = -1, [], []
        for step in range(STEPS + 1):
            now_ns = step * PERIOD_NS
            states.append(z[:n])
            error = float(np.linalg.norm(x_s - z[:n]))
            if self.measured[step] and (not common or error > self.trigger.threshold(now_ns)):
                x_s, common = z[:n], True
                if self.delivered(len(events)):
                    wait_ns = self.delay_ns(len(events)) if delay else 0
                    in_flight.append((now_ns + wait_ns, len(events), now_ns, z[:n]))
                events.append(step)
            at_ns = now_ns
            for acts_ns, number, event_ns, x in sorted(in_flight, key=lambda entry: entry[:2]):
                if acts_ns >= now_ns + PERIOD_NS:
                    continue
                z = transition(acts_ns - at_ns) @ z
                at_ns = acts_ns
                if number > newest:
                    newest = number
                    z = np.concatenate([z[:n], transition(acts_ns - event_ns)[n:, n:] @ x])
                in_flight = [entry for entry in in_flight if entry[1] != number]
            z = transition(now_ns + PERIOD_NS - at_ns) @ z
            x_s = transition(PERIOD_NS)[n:, n:] @ x_s
        return np.array(states), events


@st.composite
def cases(draw: st.DrawFn) -> Case:
    n, m = draw(st.integers(1, 4)), draw(st.integers(1, 2))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    A, B, K = (rng.uniform(-1, 1, shape) for shape in ((n, n), (n, m), (m, n)))
    H = A + B @ K + draw(st.sampled_from([0.0, 0.1, 1.0])) * rng.uniform(-1, 1, (n, n))
    H *= draw(st.sampled_from([0.0, 1.0]))
    every = draw(st.sampled_from([1, 3]))
    measured = [step % every == 0 for step in range(STEPS + 1)]
    measured[draw(st.integers(0, 20))] = False
    names = tuple("abcd"[:n])
    loop = LoopMatrices(A, B, K, H, A, B, rng.uniform(-1, 1, n), None, names, names[:m])
    overtaking_within_a_step = st.just([27_000_000, 12_000_000])
    anything = st.lists(st.integers(0, 5 * PERIOD_NS), min_size=1, max_size=5)
    delays = st.one_of(overtaking_within_a_step, anything)
    return Case(
        loop,
        decaying_rule(draw(st.sampled_from([0.003, 0.03, 0.3])), 0.5, 1e-4, n=n),
        measured,
        draw(st.lists(st.booleans(), min_size=1, max_size=6)),
        draw(delays),
        draw(st.booleans()),
    )


@pytest.mark.parametrize("delay", [False, True])
@given(case=cases())
@settings(max_examples=15)
def test_it_is_what_one_exponential_after_another_gives(delay: bool, case: Case) -> None:
    x, events = case.sampled(delay=delay)
    expected, expected_events = case.naive(delay=delay)
    assert events == expected_events
    # 200 products on one side, each with an error of about 1e-16 of the state, which may grow.
    np.testing.assert_allclose(x, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def comparable(number: int) -> dict[str, Any]:
    """A random scenario without what the loop on the plant's grid does not have."""
    content = random_scenario(number)
    plant, network, controller = content["plant"], content["network"], content["controller"]
    for section, keys in (
        (content, ("observer", "changes")),
        (plant, ("disturbances", "measurement", "watchdog")),
        (network, ("protocol", "acknowledgements", "actuation")),
        (controller, ("setpoint", "safe_input", "predictions")),
    ):
        for key in keys:
            section.pop(key, None)
    return content


@pytest.mark.parametrize("first", range(len(POLICIES)))
def test_with_all_effects_it_is_what_the_machines_do(first: int) -> None:
    """Losses, delays, reordering, all kinds of rates and phases."""
    for number in range(first, 6 * len(POLICIES), len(POLICIES)):
        record = simulate(resolve(validate(comparable(number), "random")))
        live = live_run(record)
        system = ContinuousLoop(record.loop, policy_of(record.scenario))
        known = record.scenario.network.initial_sync == "known_state"
        run = PlantGridLoop(system, live.schedule, known_start=known).run(delay=True, hold=True)
        expected = record[PLANT_STEP]["x"][: len(run.x)]
        np.testing.assert_allclose(run.x, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
        period_s = record.scenario.timing.plant_period_ns * 1e-9
        np.testing.assert_allclose(run.event_steps * period_s, live.event_s, rtol=1e-12)
