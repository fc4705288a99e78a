"""Which of the loops that are tried is used: one with proven bounds.

If the plant has friction, the first loop with proven bounds is used. Every other loop is certified without a
search, in seconds. The first loop whose bound of ‖x‖ is below 200 times ‖x(0)‖ is used, else the loop with
the smallest bound. If no loop has a bound, the first one is tried with a norm that counts errors by what they
do to the input. Then the last threshold is chosen for the allowed errors, with proofs.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from cosim.analysis.certificates import Certificates, certificates_of
from cosim.analysis.claims.run_certificates import RUN_WORK
from cosim.analysis.scenario_certificates import quick_certificate
from cosim.output.run_verdict import SETTLED_SHARE
from cosim.simulation.virtual_time import simulate_loops
from cosim.studies.new_loop.choices import Choices
from cosim.studies.new_loop.trial_scenario import (
    LARGEST_FLOOR_SHARE,
    SMALL_FLOOR_SHARE,
    content_of,
    scenario_of,
)
from cosim.studies.new_loop.trials import LoopTrial
from netem.core.errors import CallerError
from netem.core.number_format import to_digits
from noack.core.linear_systems import norm
from noack.plants.linear import LinearSettings
from noack.scenario.resolution import resolve, resolve_run
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.coverage import require_linear
from noack.theory.response_bounds import NotDecayingError
from noack.theory.trigger_norm import input_norm
from noack.theory.witnesses.effort import MOST_WORK
from noack.trigger_policies.decaying import DecayingSettings

Report = Callable[[str], None]
"""Called with the present step, in words."""
_LOOSE_BOUND_RATIO = 200.0
"""A bound of ‖x‖ above this multiple of ‖x(0)‖ is used only if there is no other."""


def best_trial(choices: Choices, trials: Sequence[LoopTrial], report: Report) -> LoopTrial:
    """Return the trial that is used."""
    candidates: list[tuple[float, LoopTrial]] = []
    if trials[0].has_friction and choices.allowed:
        return trials[0]  # only a proof about the plant itself counts
    contents = set[str]()
    easiest = {(id(trial.gain), trial.rate_hz): trial for trial in trials}  # the last: fewest losses
    for number, trial in enumerate(trials):
        report(f"certifying: {number + 1} of {len(trials)}")
        loop, content = (id(trial.gain), trial.rate_hz), str(content_of(choices, trial))
        if loop not in easiest or content in contents:  # the given settings exclude it
            continue
        contents.add(content)
        bound = certificate_of(choices, trial).first("x")
        if bound is None:
            if not certificate_of(choices, easiest[loop]).exists:
                del easiest[loop]
            continue
        candidates.append((bound / (norm(trial.x0) or 1.0), trial))
        if candidates[-1][0] <= _LOOSE_BOUND_RATIO:
            return trial
    if candidates:
        return min(candidates, key=lambda entry: entry[0])[1]
    return _with_input_norm(choices, trials[0])


def _with_input_norm(choices: Choices, trial: LoopTrial) -> LoopTrial:
    """Return a trial with the norm that counts errors by what they do to the input, if that certifies it."""
    model, K = trial.gain.model, trial.gain.K
    if trial.gain.integrals or trial.weight is not None:  # W is of the states alone
        return trial
    with suppress(NotDecayingError):
        weight = input_norm(model.A + model.B @ K, K, trial.alpha_per_s)
        weighted = replace(trial, weight=weight)
        if certificate_of(choices, weighted).exists:
            return weighted
    return trial


def certificate_of(choices: Choices, trial: LoopTrial) -> ScenarioCertificate:
    """Return the certificate of a trial's linear plant that needs no search, perhaps void."""
    resolved = resolve(scenario_of(choices, trial))
    if not resolved.coverage.is_linear:
        A, B = (tuple(map(tuple, M.tolist())) for M in resolved.model.matrices)
        linear = {"system": LinearSettings(), "draw": "given", "A": A, "B": B}
        resolved = resolved.model_copy(update={"plant": resolved.plant.model_copy(update=linear)})
    resolved.coverage.require_unchanging()
    require_linear(resolved)
    return quick_certificate(resolved)


def returns_to_rest(choices: Choices, trial: LoopTrial) -> bool:
    """Return whether the loop settles in virtual time, as the verdict of a run has it.

    Raises:
        CallerError: the plant cannot be simulated.
    """
    run = simulate_loops(resolve_run(scenario_of(choices, trial)))
    for notice in run.loop().notices:
        if notice["level"] == "failed":
            raise CallerError(f"{choices.model.plant.label}: {notice['text']}")
    sizes = np.linalg.norm(run.loop().columns("plant_step", "x")["x"], axis=1)
    return bool(np.isfinite(sizes).all() and sizes[-1] <= SETTLED_SHARE * sizes.max())


class TrialProofs:
    """Bounds that are proven of trials; what was proven of the last trial speeds up the next search."""

    def __init__(self, choices: Choices) -> None:
        self.choices = choices
        self._near: Sequence[Mapping[str, object]] = ()

    def of(self, trial: LoopTrial) -> Certificates:
        """Return the certificates of a trial, with the bounds that are proven."""
        results = certificates_of(scenario_of(self.choices, trial))
        most_work = 2 * RUN_WORK if self.choices.is_linear else MOST_WORK
        found = results.prove(most_work=most_work, conditions=("schedule",), near=self._near)
        documents = [each.document for each in found.statements if each.document is not None]
        self._near = documents or self._near
        return results


def with_threshold(choices: Choices, trial: LoopTrial, report: Report) -> tuple[LoopTrial, Certificates]:
    """Return the trial with the last threshold that the allowed errors need, and its certificates.

    A bound that does not decay is proportional to this threshold, where nothing disturbs the plant. In the
    end it is 60 to 100 % of the allowed error, if three thresholds are enough for that.
    """
    proofs, most_thresholds = TrialProofs(choices), 3
    trial, results = proven = _with_proof(choices, trial, proofs, report)
    for number in range(most_thresholds):
        if number:
            report(f"searching for proofs: threshold {number + 1}")
            results = proofs.of(trial)
            if results.guaranteed is None:
                trial, results = proven
                break
        proven = trial, results
        floor = _better_floor(choices, trial, results)
        if floor is None or number == most_thresholds - 1:
            break
        trial = replace(trial, floor=floor)
    if results.guaranteed is not None:
        times_s = [bound.settles_s or 0.0 for bound in results.output_bounds(results.guaranteed)]
        trial = replace(trial, guaranteed_from_s=max(times_s, default=0.0))
    return trial, results


def _better_floor(choices: Choices, trial: LoopTrial, results: Certificates) -> float | None:
    """Return the last threshold with which bounds become 85 % of the allowed errors; None: keep it."""
    used = results.scenario.trigger
    is_free = choices.leaves("trigger", "trigger.floor") and isinstance(used, DecayingSettings)
    if results.guaranteed is None or not is_free:
        return None
    assert isinstance(used, DecayingSettings)
    largest = largest_share(results)
    if largest <= 1.0 and (largest >= 0.6 or trial.has_friction):
        return None
    wanted = to_digits(min(used.floor * 0.85 / largest, LARGEST_FLOOR_SHARE * used.beta), 2)
    return None if wanted == used.floor else wanted


def largest_share(results: Certificates) -> float:
    """Return the largest share of an allowed error that its bound has in the end.

    It is infinite without a bound.
    """
    if results.guaranteed is None:
        return math.inf
    outputs = [bound for bound in results.output_bounds(results.guaranteed) if bound.output.allowed]
    return max((bound.ultimate / (bound.output.allowed or 1.0) for bound in outputs), default=1.0)


def _with_proof(
    choices: Choices, trial: LoopTrial, proofs: TrialProofs, report: Report
) -> tuple[LoopTrial, Certificates]:
    """Return the first trial of this one and easier ones with proven bounds, else this one."""
    report("searching for proofs")
    first = trial, proofs.of(trial)
    if first[1].guaranteed is not None or not choices.allowed or "trigger" in choices.fixed_settings:
        return first
    others = list(_easier_trials(choices, trial))
    for number, other in enumerate(others, 2):
        report(f"searching for proofs: attempt {number} of {len(others) + 1}")
        if (results := proofs.of(other)).guaranteed is not None:
            return other, results
    return first


def _easier_trials(choices: Choices, trial: LoopTrial) -> Iterator[LoopTrial]:
    """Yield trials that are easier to prove: with a smaller or slower threshold, and fewer losses."""
    used = scenario_of(choices, trial).trigger
    if isinstance(used, DecayingSettings) and not trial.has_friction and not choices.is_linear:
        trial = replace(trial, floor=to_digits(SMALL_FLOOR_SHARE * used.beta, 2))
        yield trial
    if "trigger.alpha_per_s" not in choices.fixed_settings:
        trial = replace(trial, alpha_per_s=to_digits(trial.alpha_per_s / 2))
        yield trial
    if choices.leaves("network", "network.mansd"):
        fewer = dict.fromkeys((trial.mansd // 2, 1))
        yield from (replace(trial, mansd=mansd) for mansd in fewer if 0 < mansd < trial.mansd)
