"""Proofs that several tests need: found once, stored in ``witnesses/``, checked where they are used.

Tests call :func:`proved` with a name. ``python -m tests.checker.write_witnesses`` (``make witnesses``)
searches them again and writes the files.
"""

import functools
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flint import arb, fmpq

from cosim.analysis.witness_store import WitnessStore
from cosim.analysis.witnesses import WitnessedStatement, find_statement, resolved_content
from netem.core.periods import period_of
from noack.core.balls import matrix
from noack.core.schedule import LoopSchedule
from noack.proof.elaborate.loop import Loop
from noack.proof.elaborate.scenario import Enclosed, read_loop, read_region
from noack.proof.gains_document import gains_files
from noack.proof.loop_document import Naming
from noack.proof.search.results import Proof
from noack.proof.statement_proof import prove_statement
from noack.theory.certificates.proven_bounds import ProvenBounds
from noack.theory.witnesses.documents import Witness, find_witness, witness_by_gains
from noack.theory.witnesses.outward import proven_bounds
from noack_equations import enclose
from noack_gains import Document as GainsDocument
from noack_gains import Gains, read_proof
from tests.checker.loops import (
    DRIFTING,
    FILTERED_MASS,
    HOLDS,
    IDEAL,
    NOISY,
    OBSERVED,
    PERIODIC,
    SCHEDULE,
    TESTED_APART,
    double_integrator,
    early,
    holding,
    noisy,
    noisy_at,
    of_scenario,
    periodic,
    pushed,
    relative,
    undamped,
    until_due,
    with_a_box,
    with_later_events,
    with_rule,
    with_skew_noise,
)
from tests.checker.random_loops import random_loop
from tests.helpers.shipped import resolved

FOLDER = Path(__file__).parent / "witnesses"
Document = dict[str, Any]


@dataclass(frozen=True)
class Proved:
    """A loop, a document about it, and what the checker found the document to prove."""

    loop: Loop
    document: Document
    """Shared by all tests: copy it before changing it."""
    proof: Proof

    @property
    def statement(self) -> WitnessedStatement:
        """The statement about a scenario, as a search returns it."""
        plants, conditions = self.document["plants"], self.document["conditions"]
        return WitnessedStatement(plants, conditions, self.document, self.proof, bounds=self.bounds)

    @functools.cached_property
    def bounds(self) -> ProvenBounds:
        """What is proven, as certificates have it."""
        return proven_bounds(self.proof, self.loop)


@dataclass(frozen=True)
class OfLoop:
    """The proof of a loop."""

    loop: Callable[[], Loop]
    outputs: Sequence[str] = ("x", "e_c")
    ultimate: Sequence[str] = ()

    def search(self) -> Mapping[str, object]:
        """Return a document that is found anew."""
        return find_witness(self.loop(), self.outputs, ultimate=self.ultimate).document

    def loop_of(self, document: Mapping[str, object]) -> Loop:
        """Return the loop."""
        return self.loop()


def enclosed_equations(resolved: Mapping[str, Any], document: Mapping[str, Any]) -> Enclosed:
    """Return the equations of a search's document, enclosed over its region."""
    B = resolved["model"]["B"]
    region = read_region(document, len(B), len(B[0]))
    return Enclosed(enclose(document["equations"], region), region)


@dataclass(frozen=True)
class OfScenario:
    """The proof of a statement about a shipped scenario: its plants and conditions."""

    name: str
    settings: Sequence[str]
    plants: str = "own"
    conditions: str = "schedule"
    longer: Mapping[str, fmpq] | None = None
    """Some times are at least these, as those of a run that was late."""

    def search(self) -> Mapping[str, object]:
        """Return a document that is found anew."""
        scenario = resolved(self.name, *self.settings)
        found = find_statement(scenario, self.plants, self.conditions, longer=self.longer)
        assert found.document is not None, found.reason
        return found.document

    def loop_of(self, document: Mapping[str, object]) -> Loop:
        """Return the loop, on the region of the document if it has one."""
        content = resolved_content(resolved(self.name, *self.settings))
        enclosed = enclosed_equations(content, document) if self.plants == "region" else None
        is_ideal = self.conditions == "ideal"
        return read_loop(
            content, box=self.plants == "box", ideal=is_ideal, enclosed=enclosed, longer=self.longer
        )


def at_rate_0(floor: float) -> Loop:
    """Return a loop whose threshold does not decay."""
    return with_rule(double_integrator(IDEAL, floor=floor), rate=arb(0))


_SCHEDULE = LoopSchedule(period_of(100.0), 1, period_of(50.0), 0.0, network_delay_s=0.01)
UNTIL_IT_ACTS = fmpq(_SCHEDULE.bounds.delay_ns, 10**9)
"""An update is 10 ms in the network, waits up to 20 ms for a tick, whose input acts at the next step."""
_TESTED = IDEAL._replace(sampling=fmpq(1, 100), least_sampling=fmpq(1, 100), delay=fmpq(1, 100))
_PUSHED_AND_FLOORED = pushed(double_integrator(floor=0.05), 1.0)._replace(pushes=matrix([[0.0], [0.1]]))
RANDOM = (
    ("threshold", 105, ("x", "e_c")),
    ("threshold", 108, ("x", "e_c")),
    ("long delays", 9, ("x", "e_c")),  # a relative rule, one later event
    ("periodic", 11, ("x",)),
    ("periodic", 14, ("e_c",)),
)
"""Random loops with few states, of which proofs are short."""
ANGLE = 'outputs=[{name="angle", row=[1.0, 0.0]}]'
BELT = (
    # A load that the voltage cannot cancel: dφ/dt = ω + d, so the shaft rests at 0 with ω = −d.
    "model.load=[[1.0],[309.75]]", 'model.hold=["shaft_angle"]', "horizon_s=4",
    'outputs=[{name="shaft_angle",row=[1,0],allowed=0.1},{name="speed",row=[0,1],allowed=2.0}]',
)  # fmt: skip
LATE = {"delay": 2 * of_scenario("double_integrator").times.delay}
_MUTATED = ("x", "y[1]", "e_s", "e_c")

SEARCHES: dict[str, OfLoop | OfScenario] = {
    "double_integrator": OfLoop(double_integrator),
    "ideal": OfLoop(lambda: double_integrator(IDEAL)),
    "ideal_floor": OfLoop(lambda: double_integrator(IDEAL, floor=0.01)),
    "rate_0": OfLoop(lambda: at_rate_0(0.0)),
    "rate_0_floor": OfLoop(lambda: at_rate_0(0.01)),
    "ideal_pushed": OfLoop(lambda: pushed(double_integrator(IDEAL), 1e-6)),
    "holding": OfLoop(holding),
    "holding_decaying": OfLoop(lambda: holding(level=0.05)),
    "relative_0.02": OfLoop(lambda: relative(0.02)),
    "relative_0.2": OfLoop(lambda: relative(0.2)),
    "relative_tested": OfLoop(lambda: relative(0.1)._replace(times=_TESTED)),
    "in_the_limit": OfLoop(lambda: _PUSHED_AND_FLOORED, ("x",), ultimate=("x", "y[1]")),
    "outputs": OfLoop(
        lambda: double_integrator()._replace(outputs=matrix([[1.0, 1.0], [0.0, 3.0]])), ("x", "y[0]", "y[1]")
    ),
    "early_0.005": OfLoop(lambda: early(0.005)),
    "early_0.05": OfLoop(lambda: early(0.05)),
    "until_due": OfLoop(until_due),
    "delay_0.01": OfLoop(lambda: double_integrator(SCHEDULE._replace(delay=fmpq(1, 100)))),
    "until_it_acts": OfLoop(lambda: double_integrator(SCHEDULE._replace(delay=UNTIL_IT_ACTS))),
    "noisy": OfLoop(lambda: NOISY),
    "without_noise": OfLoop(lambda: double_integrator(floor=0.03)),
    "noisy_0": OfLoop(lambda: noisy_at(0)),
    "noisy_1": OfLoop(lambda: noisy_at(1)),
    "undamped": OfLoop(undamped),
    "undamped_noisy": OfLoop(lambda: noisy(undamped(), 0.01)),
    "early_noisy": OfLoop(lambda: noisy(with_rule(early(0.05), floor=arb(0.03)))),
    "observed": OfLoop(lambda: OBSERVED),
    "holds": OfLoop(lambda: HOLDS),
    **{f"periodic_{name}": OfLoop(lambda loop=loop: loop) for name, loop in PERIODIC.items()},  # type: ignore[misc]
    "of_scenario": OfLoop(lambda: of_scenario("double_integrator")),
    "periodic_ideal": OfLoop(lambda: periodic(fmpq(1, 2), fmpq(1, 2), IDEAL), ("x",)),
    **{f"tests_{name}": OfLoop(loop) for name, loop in TESTED_APART.items()},
    **{name.replace(" ", "_"): OfLoop(lambda loop=loop: loop, ("x",)) for name, loop in DRIFTING.items()},  # type: ignore[misc]
    "changed_plain": OfLoop(double_integrator, _MUTATED),
    "changed_pushed": OfLoop(with_a_box, _MUTATED),
    "changed_later": OfLoop(with_later_events, _MUTATED),
    "changed_noisy": OfLoop(with_skew_noise, _MUTATED),
    "changed_observed": OfLoop(lambda: OBSERVED, _MUTATED),
    **{
        f"random_{kind.replace(' ', '_')}_{seed}": OfLoop(
            lambda kind=kind, seed=seed: random_loop(np.random.default_rng(seed), kind),  # type: ignore[misc]
            outputs,
        )
        for kind, seed, outputs in RANDOM
    },
    "claims": OfScenario("double_integrator", ()),
    "claims_late": OfScenario("double_integrator", (), longer=LATE),
    "claims_box": OfScenario("double_integrator", (), "box"),
    "claims_box_late": OfScenario("double_integrator", (), "box", longer=LATE),
    "claims_belt": OfScenario("dc_motor_load", BELT),
    "pendulum": OfScenario("unstable_pendulum", ()),
    "pendulum_ideal": OfScenario("unstable_pendulum", (), conditions="ideal"),
    "filtered_mass": OfScenario("double_integrator", FILTERED_MASS, "own", "schedule"),
    "dc_motor_load": OfScenario("dc_motor_load", (), "own", "schedule"),
    "servo_reference": OfScenario("servo_reference", (), "box", "schedule"),
    "friction_servo": OfScenario("friction_servo", (), "region", "schedule"),
    "sine_pendulum_angle": OfScenario("sine_pendulum", (ANGLE,), "region", "schedule"),
    "sine_pendulum": OfScenario("sine_pendulum", (), "region", "ideal"),
    "sine_pendulum_schedule": OfScenario("sine_pendulum", ("network.mansd=2",), "region", "schedule"),
}
"""By name, all proofs that are stored."""


OUTPUTS = ("x", "e_s", "e_c", "x[0]", "y[0]", "u[0]")
"""What bounds by gains are of."""


def by_gains(loop: Loop) -> tuple[Document, Proof]:
    """Return the document of a loop that is found by gains, without a search, and what it proves."""
    is_moved = loop.push_before_input is not None
    witness = witness_by_gains(loop, [name for name in OUTPUTS if not (is_moved and name[0] == "u")])
    return dict(witness.document), witness.proof


def gains_of(loop: Loop, document: Mapping[str, object]) -> Gains:
    """Return the argument by gains of a document that is found by a search."""
    files = gains_files(loop, document, Naming("loop"))
    of = GainsDocument(files.document)
    return Gains(of, read_proof(of, files.proof))


@functools.cache
def proved(name: str) -> Proved:
    """Return a stored document, checked against its loop."""
    document = json.loads((FOLDER / f"{name}.json").read_text())
    loop = SEARCHES[name].loop_of(document)
    return Proved(loop, document, prove_statement(loop, document))


def use_stored(monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
    """Let searches of loops that have the same numbers find these proofs; others are searched."""
    stored = {WitnessStore(proved(name).loop).name: name for name in names}

    def find(loop: Loop, outputs: Sequence[str], **options: Any) -> Witness:
        name = stored.get(WitnessStore(loop).name)
        if name is None:
            return find_witness(loop, outputs, **options)
        return Witness(proved(name).document, proved(name).proof)

    monkeypatch.setattr("cosim.analysis.witnesses.find_witness", find)
