"""Sentences about a new loop: its settings, its guarantee, its simulation."""

from collections.abc import Iterator

import numpy as np

from cosim.analysis.certificates import Certificates
from cosim.output.guarantee_sentence import guarantee_sentence, is_within_allowed
from cosim.studies.new_loop.trials import LoopTrial
from noack.core.linear_systems import Vector
from noack.theory.certificates.certified_bounds import ScenarioCertificate


def guarantee_text(results: Certificates) -> str:
    """Return the sentence of ``noack certify`` about the plant itself."""
    sentence = guarantee_sentence(results)
    if sentence is None:
        return f"no guarantee: {results.answer.text}"
    return sentence if is_within_allowed(results) else f"no guarantee of the allowed error: {sentence}"


def bound_notes(results: Certificates, start: Vector) -> Iterator[str]:
    """Yield of each output whose proven bound is larger than its allowed error what this means."""
    certificate = results.guaranteed
    for bound in () if certificate is None else results.output_bounds(certificate):
        output, first = bound.output, abs(float(np.array(bound.output.row)[: len(start)] @ start))
        if bound.is_met:
            continue
        least = output.quantity(f"{bound.ultimate:.3g}")
        if bound.ultimate >= first:
            yield (
                f"The proven bound of {output.name}, {least}, is not smaller than its value at the start, "
                f"{output.quantity(f'{first:.3g}')}: it says only that {output.name} stays bounded."
            )
        yield (
            f"For a smaller bound of {output.name}, choose a slower gain (noack gain --r), fewer losses "
            "(--set network.mansd) or a smaller x(0) (--x0)."
        )


def loop_notes(
    trial: LoopTrial, certificate: ScenarioCertificate, returns: bool, *, of_plant: bool
) -> Iterator[str]:
    """Yield what was chosen and found, a sentence each; ``of_plant``: a guarantee is for the plant itself."""
    yield f"u = K x_c: {trial.gain.method}; without errors x decays as e^(−{trial.gain.decay_per_s:.3g}t)."
    plant = "the plant" if of_plant else "the linear plant ẋ = Âx + B̂u"
    if of_plant:
        pass
    elif not certificate.has("x"):
        yield (
            f"No certificate was found for {plant}: {certificate.void}. Rates, gains and mansd were "
            "tried; noack certify tries other settings, and names those with a certificate."
        )
    else:
        bound = certificate.formula("‖x‖", "x")
        losses = certificate.conditions.guarantee.meaning
        yield f"Certified for {plant}, for every pattern of losses with {losses}: {bound}."
    if not of_plant:
        errors = ", ".join(
            f"{of_states.max():.2g} within ±{within:g}" for within, of_states in trial.gain.model.errors
        )
        yield (
            "This is not about the plant itself. If its equations are known, noack certify searches a "
            "certificate of them; without one, a run checks only what "
            "holds for every plant; with --set 'plant.system={kind=\"linear\"}' a run has the "
            "linear plant, and is checked against its certificate. Largest relative error of the "
            f"linear model, sampled: {errors}."
        )
    start = ", ".join(f"{entry:.3g}" for entry in trial.x0)
    end = "returns to 0" if returns else "does not return to 0"
    yield f"Simulated from x(0) = ({start}), the loop {end}."


_SMALL_EFFECT = 0.1
"""With a smaller entry of B, per second, the weights 1 of a state and of an input give a slow loop."""


def input_notes(trial: LoopTrial) -> Iterator[str]:
    """Yield what to do if the regulator, which weighs inputs like states, hardly uses an input."""
    effect = float(np.abs(trial.gain.model.B).max(initial=0.0))
    if not trial.has_friction and 0 < effect < _SMALL_EFFECT:
        label = trial.gain.model.plant.label
        yield (
            f"One unit of an input changes states by at most {effect:.2g} per second, so it is used little. "
            f"For a faster loop: noack gain {label} --r R --out gain.json, R below 1; noack new gain.json."
        )
