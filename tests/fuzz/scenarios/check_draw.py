"""What is checked of a drawn scenario, from reading it to its worst losses.

A mistake of noack is a *contradiction*: a traceback, a message of several lines, a replay that
differs, a claim or bound that is violated, or a step that takes too long. A draw may be refused, with
one line. A search, as of a proof, may end without a result; one that takes too long is counted.
"""

import contextlib
import io
import json
import signal
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType
from typing import NamedTuple

import numpy as np

from cosim.analysis.adversary import Objective, find_worst
from cosim.analysis.certificates import certificates_of
from cosim.analysis.replay.run_replay import replay_run
from cosim.analysis.scenario_certificates import certificate_of, quick_certificate
from cosim.analysis.witnesses import find_statement, plants_of
from cosim.cli.scenario_check import check_scenario
from cosim.live.finalize import finalize
from cosim.record.run_directory import RunEnding
from cosim.record.run_record import load_run
from cosim.simulation.virtual_time import simulate_run
from netem.core.errors import NoackError
from noack.proof.search.results import Proof
from noack.scenario.resolution import loop_of, resolve, resolve_run, resolved_loops
from noack.scenario.scenario import Scenario, loops_by_entry
from noack.scenario.scenario_file import dumps, load
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import allowed_conditions, ideal_conditions
from noack.trigger_policies.decaying import DecayingSettings
from tests.fuzz.scenarios.draws import Draw, draw, drawn_keys
from tests.fuzz.scenarios.proven_bounds import proven_limit, sizes_of
from tests.oracles.explained_run.explain import explains
from tests.oracles.paper_attacks import largest_share

LIMIT_S = 60.0
"""Largest CPU time of a step."""
_NODES, _BEAM, _PAPER_PATTERNS = 400, 8, 10
"""Effort of the adversary, for each objective; patterns that are tried in the paper's loop."""
_MOST_FINDINGS = 5
"""Findings of a run that the model does not explain that are listed."""
_PROGRESS = "noack: checking claims"
"""How lines about long work begin, which are no warnings."""
_MOST_ENTRIES = 2
"""Entries of [[loops]] whose loop is certified and attacked."""
TOO_LONG = ": search too long"
"""What the count of searches that reach their limit ends with, after the name of the step."""
_MOST_LETTERS = 700
"""Longest message of a refusal."""


class Contradiction(NamedTuple):
    """Something that must not be."""

    seed: int
    number: int
    step: str
    what: str
    detail: str = ""


class Checked(NamedTuple):
    """What became of a draw."""

    seed: int
    number: int
    is_refused: bool
    contradictions: list[Contradiction]
    keys: set[str]
    """The keys that it sets; none if it is refused."""
    counts: Counter[str]
    """How often each thing was done, such as "certified"."""
    refusals: Counter[str]
    """The messages of refusals, each after its step."""


class TooLongError(Exception):
    """A step has taken more CPU time than its limit."""


class Checks:
    """The steps of one draw."""

    def __init__(self, drawn: Draw, folder: Path, limit_s: float) -> None:
        self.drawn, self.folder, self.limit_s = drawn, folder, limit_s
        self.contradictions: list[Contradiction] = []
        self.counts, self.refusals = Counter[str](), Counter[str]()

    def add(self, step: str, what: str, detail: str = "") -> None:
        self.contradictions.append(Contradiction(self.drawn.seed, self.drawn.number, step, what, detail))

    @contextlib.contextmanager
    def step(self, name: str, *, may_refuse: bool = True, searches: bool = False) -> Iterator[None]:
        """Do a step, with a limit of its CPU time; any exception but a refusal is a contradiction.

        A step that ``searches`` may reach the limit, which is counted.
        """
        try:
            with _limited(self.limit_s), warnings.catch_warnings(action="error"):
                warnings.filterwarnings("default", category=DeprecationWarning)
                yield
            self.counts[name] += 1
        except NoackError as error:
            self.counts[f"{name}: refused"] += 1
            self.refusals[f"{name}: {str(error).replace(f'{self.folder}/', '')}"] += 1
            if not may_refuse:
                self.add(name, f"refused: {error}")
            elif fault := fault_of_message(str(error)):
                self.add(name, f"{fault}: {error}")
        except TooLongError:
            if searches:
                self.counts[f"{name}{TOO_LONG}"] += 1
                return
            self.add(name, f"more than {self.limit_s:g} s of CPU time", traceback.format_exc(limit=-6))
        except Exception as error:
            self.add(name, f"{type(error).__name__}: {error}", traceback.format_exc(limit=-6))

    def read(self, path: Path) -> Scenario | None:
        """Return the scenario; None if it is refused."""
        with self.step("check"):
            scenario = load(path)
            with contextlib.redirect_stdout(io.StringIO()):
                check_scenario(scenario, json=False)
            return scenario
        return None

    def read_again(self, scenario: Scenario) -> None:
        """Check that what ``noack check`` prints is the same scenario, and that its run is the same."""
        with self.step("read again", may_refuse=False):
            printed = resolve_run(scenario)
            path = self.folder / "printed.toml"
            path.write_text(dumps(printed.scenario))
            if resolved_loops(load(path)) != printed.loops:
                self.add("read again", "the scenario that noack check prints is another one")

    def simulate(self, scenario: Scenario) -> RunEnding | None:
        """Simulate the run, replay it, and explain it; return how it ended, None if it is refused."""
        ending = None
        with self.step("simulate"):
            ending = simulate_run(scenario, self.folder / "runs")
        if ending is None:
            return None
        with self.step("replay", may_refuse=False):
            result = replay_run(load_run(ending.run_dir))
            if not result.bit_exact:
                self.add("replay", str(result.first_difference), str(result))
        with self.step("explain", may_refuse=False):
            for record in load_run(ending.run_dir).loops:
                if findings := explains(record):
                    lines = "\n".join(map(str, findings[:_MOST_FINDINGS]))
                    self.add("explain", f"{record.scenario.name}: {len(findings)} findings", lines)
        return ending

    def evaluate(self, ending: RunEnding) -> None:
        """Write the summary of a run, with the verdicts of its claims."""
        warned = io.StringIO()
        with self.step("finalize", may_refuse=False, searches=True), contextlib.redirect_stderr(warned):
            summary = finalize(ending, report=False, view=False).summary
            warnings = [line for line in warned.getvalue().splitlines() if not line.startswith(_PROGRESS)]
            if warnings:
                self.add("finalize", "\n".join(warnings))
            for loop in summary.loops:
                if loop.unintended_losses:
                    self.add("simulate", f"{loop.name}: {loop.unintended_losses} unintended losses")
                for claim in loop.claims:
                    self.counts[f"claim {claim.verdict}"] += 1
                    if claim.verdict == "violated":
                        values = f"observed {claim.observed}, certified {claim.certified}"
                        self.add("claims", f"{loop.name}: {claim.what} {claim.bound}: {values}", claim.source)

    def certify(self, loop: Scenario) -> None:
        """Certify a loop under both conditions."""
        with self.step("certify", searches=True):
            results = certificates_of(loop)
            json.dumps([certificate.to_json() for _, certificate in results], allow_nan=False)
            self.counts["certified"] += results.answer.is_certified

    def attack(self, loop: Scenario) -> None:
        """Search for losses that exceed a certified bound."""
        self._attack(resolve(loop))

    def _attack(self, resolved: Scenario, certificate: ScenarioCertificate | None = None) -> None:
        if certificate is None:
            with self.step("certificate to attack", searches=True):
                certificate = quick_certificate(resolved)
        for objective in (Objective.ERROR, Objective.STATE, Objective.INTER_EVENT):
            if certificate is None:
                return
            with self.step("attack", searches=True):
                worst = find_worst(
                    resolved, objective, most_nodes=_NODES, beam=_BEAM, certificate=certificate
                )  # fmt: skip
                self.counts["attacked with a bound"] += worst.certified is not None
                if worst.breaches:
                    values = f"found {worst.value}, certified {worst.certified}"
                    what = f"{resolved.name}: {objective.value}: {values}"
                    self.add("attack", what, worst.text)

    def prove(self, loop: Scenario, ending: RunEnding | None) -> None:
        """Search for a witness of a loop, and for runs and losses that exceed what it proves."""
        resolved = resolve(loop)
        for conditions in ("schedule", "ideal"):
            proof = None
            with self.step(f"prove, {conditions}", searches=True):
                plants = plants_of(resolved)[0]
                statement = find_statement(resolved, plants, conditions)
                proof = statement.proof
                self.refusals[f"prove: {statement.reason}"] += proof is None
            if proof is None:
                continue
            self.counts[f"proven, {conditions}"] += 1
            is_ideal = conditions == "ideal"
            if not is_ideal and ending is not None:
                self.compare(ending, proof)
            is_attacked = isinstance(resolved.trigger, DecayingSettings) and resolved.coverage.is_undisturbed
            if resolved.coverage.is_linear and (not is_ideal or is_attacked):
                assumed = ideal_conditions(resolved) if is_ideal else allowed_conditions(resolved)
                certificate = certificate_of(resolved, statement, assumed)
                if not is_ideal:
                    self._attack(resolved, certificate)
                    continue
                with self.step("attack", searches=True):
                    if (share := largest_share(resolved, certificate, _PAPER_PATTERNS)) > 1 + 1e-9:
                        self.add("attack", f"{resolved.name}, the paper's loop: {share} of a bound")

    def compare(self, ending: RunEnding, proof: Proof) -> None:
        """Compare the states and errors of a run of one loop with what is proven.

        About a reference that moves this is left to the run's claims.
        """
        records = [*load_run(ending.run_dir).loops]
        if len(records) > 1 or records[0].scenario.changes:
            return
        if getattr(records[0].scenario.controller, "reference", ()):
            return
        loop = loop_of(records[0].scenario)
        rest = loop.rest if loop.reference is None else loop.reference.state(0)
        for output, t_s, sizes in sizes_of(records[0], rest):
            limit = proven_limit(proof, output, t_s)
            if len(over := np.flatnonzero(sizes > limit * (1 + 1e-9) + 1e-12)):
                at = over[0]
                what = f"‖{output}‖ = {sizes[at]:.6g} at {t_s[at]:.4f} s, proven {limit[at]:.6g}"
                self.add("prove", what)


def check_draw(
    seed: int, number: int, limit_s: float = LIMIT_S, *, theory: bool = True, witnesses: bool = False
) -> Checked:
    """Draw a scenario, and check all that is done with it; without theory only its run."""
    drawn = draw(seed, number)
    with TemporaryDirectory(prefix="noack-fuzz-") as folder:
        checks = Checks(drawn, Path(folder), limit_s)
        scenario = checks.read(drawn.write(Path(folder)))
        if scenario is not None:
            checks.read_again(scenario)
            ending = checks.simulate(scenario)
            if theory and ending is not None:
                checks.evaluate(ending)
            for loops in loops_by_entry(scenario)[: _MOST_ENTRIES if theory else 0]:
                checks.certify(loops[0])
                checks.attack(loops[0])
                if witnesses:
                    checks.prove(loops[0], ending)
    keys = set[str]() if scenario is None else drawn_keys(drawn.content)
    return Checked(
        seed, number, scenario is None, checks.contradictions, keys, checks.counts, checks.refusals
    )


def fault_of_message(message: str) -> str | None:
    """Return what is wrong with the message of a refusal; None if it is one clear line."""
    if len(message.splitlines()) != 1:
        return "not one line"
    if len(message) > _MOST_LETTERS:
        return f"{len(message)} letters"
    if any(word in message for word in ("Traceback", "<class", " object at 0x")):
        return "not for a user"
    return None


@contextlib.contextmanager
def _limited(limit_s: float) -> Iterator[None]:
    """Raise TooLongError in a body that takes more CPU time than the limit."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise TooLongError

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, limit_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)
