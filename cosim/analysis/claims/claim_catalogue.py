"""The claims, after their form and the bounds that several of them share.

The identity (I1) holds for every plant, trigger and network. The paper's theorems assume a
continuous trigger, and a network without delay. A certificate claims bounds of the errors, the
state and the inter-event time: each is compared for each certificate of the scenario, as long as the run
conforms to the certificate's loop document.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from cosim.analysis.claims.observed_conditions import Reals
from cosim.analysis.claims.run_evidence import ROUNDING, ClaimEnd, RunEvidence, Samples, earliest
from cosim.analysis.summary.summary_model import ClaimKind
from netem.core.number_format import at_most
from netem.core.row_operations import row_norms
from noack.core.linear_systems import Propagator
from noack.scenario.scenario import Scenario
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import EQUATIONS
from noack.theory.certificates.output_bounds import OutputBound, escaped, output_bounds
from noack.theory.coverage import is_linear_loop

_LEAST_MARGIN, _LARGEST_MARGIN = 1e-9, 1e-6
"""Limits of the relative rounding error that is allowed in (I1)."""
_EPSILON = float(np.finfo(float).eps)
_SMALLEST_NORMAL = float(np.finfo(float).tiny)
"""Smaller numbers have fewer digits: rounding may change them by a multiple."""
_COMPLETE = "a complete record"
_CONTINUOUS = "a continuous trigger, a network without delay"
_CAPPED = "at most mansd lost in a row"
_IDEAL = f"a continuous trigger, a network and input without delay, {_CAPPED}"


class Envelope(NamedTuple):
    """A curve that bounds a measured one."""

    label: str
    quantity: str
    """``"e_c"`` for ‖e_c‖_W, ``"x"`` for ‖x‖, ``"inter_event"`` for a lower bound in seconds, or an output's
    :attr:`~noack.scenario.outputs.LoopOutput.distance`."""
    t_s: Reals
    values: Reals
    kind: Literal["certified", "identity", "printed"] = "certified"
    """The source: a certificate, identity (I1), or a formula of the paper."""


class Bound(NamedTuple):
    """The bound that a claim sets for a run, and the share of it that the run reached."""

    formula: str
    """The bound in words of mathematics; ``{}`` stands for the constant."""
    t_s: Reals
    """(k,)"""
    shares: Reals
    """Observed value over bound; for lower bounds, bound over observed value. (k,)"""
    end: ClaimEnd | None
    """The time from which nothing is claimed; that of a certificate comes in addition."""
    constant: float | None = None
    is_lower: bool = False


class ClaimBound(NamedTuple):
    """The bound that a claim sets for some samples of a run, and its curve."""

    bound: Bound | None = None
    """None if there is no claim about this run."""
    envelope: Envelope | None = None
    """The bound as a curve."""


BoundFinder = Callable[[RunEvidence, Samples, Any], ClaimBound]
"""Returns the bound that a claim sets for some samples of a run, given a certificate.

The third argument is a :class:`ScenarioCertificate`; of a claim that needs none it is None.
"""


@dataclass(frozen=True)
class ClaimDefinition:
    """A claim, in words and as a function."""

    find: BoundFinder
    statement: str
    kind: ClaimKind
    """That of certificates is evaluated for each certificate of the scenario."""
    source: str
    """That of a certificate is the certificate's."""
    quantity: str | None
    """What is bounded, as in :class:`Claim`."""
    assumes: str
    needs_ideal_loop: bool = False
    """A run that exceeds the bound does not refute it."""
    to_the_end: bool = False
    """It holds across changes of settings."""
    output: str | None = None
    """The output that it is about."""
    settles_s: float | None = None
    """From when on the output stays within its allowed error."""

    @property
    def is_certified(self) -> bool:
        """Whether a certificate claims it."""
        return self.kind is ClaimKind.CERTIFICATE


def identity(statement: str, quantity: str | None = None) -> Callable[[BoundFinder], ClaimDefinition]:
    """Make a function the definition of a claim by the identity (I1)."""
    return lambda find: ClaimDefinition(
        find, statement, ClaimKind.IDENTITY, "(I1)", quantity, _COMPLETE, to_the_end=True
    )


def of_paper(
    statement: str, source: str, assumes: str, quantity: str
) -> Callable[[BoundFinder], ClaimDefinition]:
    """Make a function the definition of a claim of the paper."""
    return lambda find: ClaimDefinition(
        find, statement, ClaimKind.PAPER, source, quantity, assumes, needs_ideal_loop=True
    )


def certified(
    statement: str, quantity: str, output: str | None = None, settles_s: float | None = None
) -> Callable[[BoundFinder], ClaimDefinition]:
    """Make a function the definition of a claim of certificates."""
    assumes = "the run conforms to the loop document of the certificate"
    return lambda find: ClaimDefinition(
        find, statement, ClaimKind.CERTIFICATE, "certificate", quantity, assumes,
        output=output, settles_s=settles_s,
    )  # fmt: skip


def norm_text(run: RunEvidence, vector: str) -> str:
    """Return how a formula writes the norm of an error, in the trigger's norm: ‖e_c‖ or ‖W e_c‖."""
    if run.record.loop.weight is None:
        return f"‖{vector}‖"
    return f"‖W({vector})‖" if " − " in vector else f"‖W {vector}‖"


def upper_shares(observed: Reals, bound: Reals) -> Reals:
    """Return the share of an upper bound that was reached, (k,); 0 if both values are 0.

    Numbers below the smallest normal one exceed no bound.
    """
    shares, most = np.zeros(len(observed)), bound + _SMALLEST_NORMAL
    return np.divide(observed, most, out=shares, where=(observed != 0) | ~(bound >= 0))


def controller_error_bound(
    run: RunEvidence,
    samples: Samples,
    formula: str,
    values: Reals,
    constant: float | None = None,
    end: ClaimEnd | None = None,
    *,
    certificate: ScenarioCertificate | None = None,
) -> Bound:
    """Return a bound of ‖e_c‖_W at the measurements, by a certificate or without one.

    It ends at a record's first gap. A certificate's bound is one of the x_c with which the acting input
    was computed.
    """
    here = samples.is_bounded
    if certificate is not None:
        here = here & run.bounds_controller_error(samples.t_s)
    # Allow for the rounding of x, which matters for a bound of that size.
    slack = run.rounding(samples.aligned.x_norm[here])
    shares = upper_shares(samples.aligned.e_c_norm[here], values[here] + slack)
    return Bound(formula, samples.t_s[here], shares, earliest([end, run.first_gap]), constant)


def least_inter_event_time(
    run: RunEvidence,
    samples: Samples,
    least_s: float,
    end: ClaimEnd | None,
    label: str,
    certificate: ScenarioCertificate | None = None,
) -> ClaimBound:
    """Return a lower bound of the inter-event time, and the same as a line over the run.

    It may not be proven between the first events.
    """
    t_s, passed_s = samples.inter_event_s
    apart_s: Reals | float = least_s
    kind: Literal["certified", "printed"] = "printed"
    if certificate is not None:
        apart_s, kind = certificate.apart_s(t_s - passed_s, run.started_s), "certified"
    formula = "t_(i+1) − t_i ≥ {} s"
    end = earliest([end, run.lost_in_rounding])
    bound = Bound(formula, t_s, apart_s / passed_s, end, least_s, is_lower=True)
    ends_s = np.array([0.0, run.record.scenario.horizon_s])
    return ClaimBound(bound, Envelope(label, "inter_event", ends_s, np.full(2, least_s), kind))


# Identity (I1), and the paper's theorems.


@identity("the controller's error is at most the sensor's error plus the missed jumps", "e_c")
def i1_controller_error(run: RunEvidence, samples: Samples, _: None) -> ClaimBound:
    """The triangle inequality for (I1)."""
    error, values = (
        "e_c" if run.record.scenario.coverage.knows_state else "x_c − x̂",
        samples.error_bounds[0],
    )
    jump = norm_text(run, "e^(H(t−t_k)) e_s(t_k)")
    formula = f"{norm_text(run, error)} ≤ {norm_text(run, 'e_s')} + Σ {jump}"
    return ClaimBound(
        controller_error_bound(run, samples, formula, values, end=run.models_apart),
        Envelope("bound from (I1)", "e_c", samples.t_s, values, "identity"),
    )


@identity("x_c − x_s is the sum of the missed jumps")
def i1_model_difference(run: RunEvidence, samples: Samples, _: None) -> ClaimBound:
    """(I1) itself, up to rounding."""
    here, margin = samples.is_bounded, _margin(run)
    residual = samples.residual[here]
    # Use the larger model state, since a missed update may have moved x_c far from x_s.
    scale = max(run.facts.largest_state, _SMALLEST_NORMAL)
    formula = "x_c − x_s = Σ e^(H(t−t_k)) e_s(t_k), relative residual ≤ {}"
    shares = residual / (margin * scale)
    end = earliest([run.models_apart, run.first_gap])
    return ClaimBound(Bound(formula, samples.t_s[here], shares, end, margin))


def _margin(run: RunEvidence) -> float:
    """Return the relative rounding error that the models may accumulate between two deliveries.

    It is n ε sup‖e^{Hτ}‖ over the time τ between deliveries, at most 1e-6.
    """
    loop, period_ns = run.record.loop, run.record.scenario.timing.measurement_period_ns
    longest_ns = run.facts.longest_update_ns
    growth, age_ns, moved = 1.0, period_ns, Propagator(loop.H).transition(period_ns)
    while age_ns <= longest_ns and growth < 1 / _EPSILON:
        growth = max(growth, float(np.linalg.norm(moved)))
        age_ns, moved = 2 * age_ns, moved @ moved
    rounding = loop.n * _EPSILON * growth
    return max(_LEAST_MARGIN, min(rounding, _LARGEST_MARGIN))


@of_paper("the paper's bound of the controller's error", "eq:LossEv3", _CONTINUOUS, "e_c")
def paper_error_bound(run: RunEvidence, samples: Samples, _: None) -> ClaimBound:
    """(I1) with the threshold in place of e_s at the events."""
    coverage = run.record.scenario.coverage
    # Estimates and noise jump at every measurement, so no trigger keeps e_s below a threshold.
    if not coverage.is_decaying or not coverage.knows_state:
        return ClaimBound()
    growth = "‖e^(H(t−t_k))‖" if run.record.loop.weight is None else "‖W e^(H(t−t_k)) W⁻¹‖"
    formula = f"{norm_text(run, 'e_c')} ≤ βe^(−αt) + Σ βe^(−αt_k) {growth}"
    return ClaimBound(controller_error_bound(run, samples, formula, samples.error_bounds[1]))


@of_paper(
    "the controller's error decays",
    "Theorem 1 (3 for a hold), Δ from this run's trajectory",
    f"{_CONTINUOUS}, {_CAPPED}",
    "e_c",
)
def theorem_1_controller_error(run: RunEvidence, samples: Samples, _: None) -> ClaimBound:
    """Theorem 1 with the Δ of the trajectory."""
    scenario = run.record.scenario
    coverage = scenario.coverage
    is_covered = is_linear_loop(scenario) and coverage.is_undisturbed and coverage.is_decaying
    if not is_covered or scenario.decaying.floor > 0 or (delta := run.trajectory_delta) is None:
        return ClaimBound()
    level = scenario.decaying.beta * np.exp(-scenario.decaying.alpha_per_s * samples.t_s)
    formula, end = f"{norm_text(run, 'e_c')} ≤ {{}} βe^(−αt)", run.paper_end
    return ClaimBound(controller_error_bound(run, samples, formula, delta * level, delta, end))


@of_paper("minimum inter-event time", "Theorem 2, eq:tau", _IDEAL, "inter_event")
def theorem_2_inter_event_time(run: RunEvidence, samples: Samples, _: None) -> ClaimBound:
    """Theorem 2's τ."""
    if run.theorem_2 is None:
        return ClaimBound()
    least = least_inter_event_time(
        run,
        samples,
        run.theorem_2.inter_event_s,
        run.paper_end,
        "Theorem 2 (eq:tau)",
    )
    knows_state = run.record.scenario.coverage.knows_state
    return least if knows_state else ClaimBound(None, least.envelope)


@of_paper("the state decays", "Theorem 2, eq:normXt", _IDEAL, "x")
def theorem_2_state(run: RunEvidence, samples: Samples, _: None) -> ClaimBound:
    """Theorem 2's bound of ‖x‖."""
    if run.theorem_2 is None:
        return ClaimBound()
    values = run.theorem_2.state(samples.step_s, run.record.scenario.decaying.alpha_per_s)
    envelope = Envelope("Theorem 2 (eq:normXt)", "x", samples.step_s, values, "printed")
    if not run.record.scenario.coverage.knows_state:
        return ClaimBound(None, envelope)
    slack = ROUNDING * run.offset
    shares = upper_shares(row_norms(samples.plant.x), values + slack)
    formula = "‖x‖ ≤ c x₀ e^(−ᾱt) + g (e^(−αt) − e^(−ᾱt))"
    return ClaimBound(Bound(formula, samples.step_s, shares, run.paper_end), envelope)


# What a certificate claims.


@certified("the controller's error is bounded", "e_c")
def controller_error(run: RunEvidence, samples: Samples, certificate: ScenarioCertificate) -> ClaimBound:
    """‖e_c‖_W from when the plant applies the controller's input on, with the x_c of this input."""
    if not certificate.has("e_c"):
        return ClaimBound()
    formula = certificate.pattern(norm_text(run, "e_c"), "e_c")
    values = certificate.controller_error(samples.t_s)
    return ClaimBound(
        controller_error_bound(
            run, samples, formula, values, certificate.first("e_c"), certificate=certificate
        ),
        Envelope(f"certified for {certificate.scope}", "e_c", samples.t_s, values),
    )


@certified("the estimation error is bounded", "estimate")
def estimation_error(run: RunEvidence, samples: Samples, certificate: ScenarioCertificate) -> ClaimBound:
    """‖x̂ − x‖_W at the measurements."""
    loop = run.record.loop
    if not certificate.has("estimate"):
        return ClaimBound()
    weight = np.eye(loop.n) if loop.weight is None else loop.weight
    here = samples.with_x
    t_s = samples.t_s[here]
    errors = row_norms((samples.aligned.x - samples.true_x).compress(here, axis=0) @ weight.T)
    formula = certificate.pattern(norm_text(run, "x̂ − x"), "estimate")
    shares = upper_shares(errors, certificate.bound(t_s, "estimate"))
    return ClaimBound(Bound(formula, t_s, shares, None, certificate.first("estimate")))


@certified("minimum inter-event time", "inter_event")
def inter_event_time(run: RunEvidence, samples: Samples, certificate: ScenarioCertificate) -> ClaimBound:
    """The time between two events."""
    if certificate.inter_event_s is None:
        return ClaimBound()
    label = f"certified for {certificate.scope}"
    return least_inter_event_time(run, samples, certificate.inter_event_s, None, label, certificate)


@certified("the sensor's error is bounded", "e_s")
def sensor_error(run: RunEvidence, samples: Samples, certificate: ScenarioCertificate) -> ClaimBound:
    """‖e_s‖_W before each reset."""
    if not certificate.has("e_s"):
        return ClaimBound()
    formula = certificate.pattern(norm_text(run, "e_s"), "e_s")
    slack = run.rounding(samples.aligned.x_norm)
    shares = upper_shares(samples.aligned.e_s_norm, certificate.sensor_error(samples.t_s) + slack)
    return ClaimBound(Bound(formula, samples.t_s, shares, None, certificate.first("e_s")))


@certified("the state is bounded", "x")
def state(run: RunEvidence, samples: Samples, certificate: ScenarioCertificate) -> ClaimBound:
    """‖x‖ at each step of the plant."""
    if not certificate.has("x"):
        return ClaimBound()
    formula = certificate.pattern("‖x − x_r‖" if run.offset else "‖x‖", "x")
    values, slack = certificate.state(samples.step_s), ROUNDING * run.offset
    shares = upper_shares(row_norms(samples.plant.x), values + slack)
    return ClaimBound(
        Bound(formula, samples.step_s, shares, None, certificate.first("x")),
        Envelope(f"certified for {certificate.scope}", "x", samples.step_s, values),
    )


def output_claims(run: RunEvidence, certificate: ScenarioCertificate) -> list[ClaimDefinition]:
    """Return the claims about the outputs that a run's scenario states: their bounds, and allowed errors."""
    scenario = run.record.scenario
    if scenario.outputs is None:
        return []
    claims = []
    stated = (run.whole_record or run.record).scenario.controller
    follows = stated.reference is not None
    rest = run.record.loop.rest.tolist()
    for bound in output_bounds(
        certificate, scenario.loop_outputs(), stated.setpoint, follows=follows, rest=rest
    ):
        if (settles_s := bound.settles_s) is not None:
            claims.append(_output_claim(bound, bound.statement, settles_s))
        claims.append(_output_claim(bound, f"{bound.output.name} is bounded"))
    return claims


def _output_claim(
    output_bound: OutputBound, statement: str, settles_s: float | None = None
) -> ClaimDefinition:
    """Return the claim of an output's bound, or that it stays within its allowed error from a time on."""
    output, certificate = output_bound.output, output_bound.certificate

    @certified(statement, "output", output.name, settles_s)
    def output_claim(run: RunEvidence, samples: Samples, of_loop: ScenarioCertificate) -> ClaimBound:
        observed = np.abs(samples.plant.x @ np.array(output.row))
        slack, t_s = ROUNDING * run.offset, samples.step_s
        if settles_s is not None and output.allowed is not None:
            later = t_s >= settles_s
            shares = observed[later] / (output.allowed + slack)
            limit = f"{escaped(output_bound.symbol)} ≤ {{}} {escaped(output.unit)}".rstrip()
            formula = f"{limit} from {at_most(settles_s, 3)} s on"
            return ClaimBound(Bound(formula, t_s[later], shares, None, output.allowed))
        values, first = certificate.state(t_s), certificate.first("x")
        return ClaimBound(
            Bound(output_bound.pattern, t_s, upper_shares(observed, values + slack), None, first),
            Envelope(f"certified for {of_loop.scope}", output.distance, t_s, values),
        )

    return output_claim


@certified("x stays in the region", "region")
def region(run: RunEvidence, samples: Samples, certificate: ScenarioCertificate) -> ClaimBound:
    """The region on which a plant's equations are enclosed, coordinate by coordinate."""
    names, x, proven = run.record.loop.state_names, np.abs(samples.plant.x), certificate.proven
    entries = {} if proven is None or certificate.scope != EQUATIONS else proven.entries(len(names), 0)
    if proven is None or not entries:
        return ClaimBound()
    limits = {i: proven.at(f"x[{i}]", samples.step_s) for i in entries}
    formulas = {i: proven.formula(f"|{names[i]}|", f"x[{i}]") for i in entries}
    formula = ", ".join(formulas[i].format(at_most(entries[i].first)) for i in entries)
    shares = np.max([x[:, i] / limit for i, limit in limits.items()], axis=0)
    return ClaimBound(Bound(formula, samples.step_s, shares, None))


CERTIFIED_AND_IDENTITY = (
    controller_error,
    estimation_error,
    inter_event_time,
    sensor_error,
    state,
    region,
    i1_controller_error,
    i1_model_difference,
)
PAPER = (paper_error_bound, theorem_1_controller_error, theorem_2_inter_event_time, theorem_2_state)


def claims_about(scenario: Scenario) -> tuple[ClaimDefinition, ...]:
    """Return the claims about a run of a scenario, in the order in which they are evaluated.

    The paper's are checked where the scenario asks for them.
    """
    return (*CERTIFIED_AND_IDENTITY, *(PAPER if scenario.certificate.paper else ()))
