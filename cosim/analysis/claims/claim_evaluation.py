"""Holds every claim about a run against its record."""

import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.claims.condition_reader import read_conditions
from cosim.analysis.claims.observed_conditions import Left, ObservedConditions, SampledSeries
from cosim.analysis.claims.theorem_one import theorem_one
from cosim.record.align import AlignedRun, identity_residual, in_common, join_all
from cosim.record.run_record import RunRecord
from noack.config.resolution import policy_of
from noack.config.scenario import Scenario
from noack.core.linear_systems import row_norms, transition
from noack.protocol.record_tables import NO_SEQUENCE, SENSOR_MEASUREMENT
from noack.protocol.topology import LOOP_ROLES
from noack.theory.certificate import NetworkConditions
from noack.theory.error_bounds import ErrorMonitor
from noack.theory.paper_bounds import Theorem2, theorem_2
from noack.theory.run_conditions import allowed_conditions, ideal_conditions, nominal_conditions
from noack.theory.scenario_certificates import (
    OWN_PLANT,
    ScenarioCertificate,
    certify,
    certify_box,
    outside_box,
)

Reals = NDArray[np.float64]

# What an exact computation may miss by rounding: the record holds 20 s in 10,000 steps.
_ROUNDING = 1e-9
_IDENTITY, _LARGEST_IDENTITY = 1e-9, 1e-6
_LONG_S = 1e300  # finite: what never came took longer
_ANY = NetworkConditions(sys.maxsize, *[_LONG_S] * 5)


class ClaimVerdict(StrEnum):
    """What the run says of a claim."""

    HELD = "held"
    VIOLATED = "violated"
    VOID = "void"
    """The run left the conditions of the claim before it could be judged to the end."""
    NOT_APPLICABLE = "not applicable"
    """The bound was exceeded, but an assumption of the claim was not met: it is not refuted."""


class Claim(NamedTuple):
    """One claim about a run and what became of it."""

    what: str
    source: str
    bound: str
    """The claim as a formula with its numbers."""
    certified: float | None
    """The claimed constant."""
    observed: float | None
    """What it would have had to be for this run."""
    ratio: float | None
    """Observed over certified for upper bounds, certified over observed for lower ones: how much
    of the bound was used; at most 1 where it held."""
    verdict: ClaimVerdict
    since_s: float | None
    """Since when it was violated, void, or not applicable."""
    why: str
    from_s: float = 0.0
    """From when on it is claimed: from the start, or after a change of settings."""
    until_s: float | None = None
    """Until when: to the end if None, else to a change of settings."""


_NO_CLAIM = Claim(
    "the models differ by what was missed", "(I1)", "none", None, None, None, ClaimVerdict.VOID,
    0.0, 'network.protocol = "ack": x_s is reset when an update is acknowledged and not at every '
    "event, which (I1) and all that rests on it presuppose",
)  # fmt: skip


class Envelope(NamedTuple):
    """A curve that bounds a measured one."""

    label: str
    quantity: Literal["e_c", "x", "inter_event"]
    """``"e_c"`` for ‖e_c‖_W, ``"x"`` for ‖x‖, ``"inter_event"`` for a lower bound in seconds."""
    t_s: Reals
    values: Reals
    kind: Literal["certified", "identity", "printed"] = "certified"
    """What it rests on: a certificate, identity (I1), or a formula printed in the paper."""


class RunPart(NamedTuple):
    """What part of a run a record is of that is judged as a run of its own."""

    whole: RunRecord
    from_s: float = 0.0
    """Its start, in the run's time."""
    until_s: float = math.inf
    """Its end, in its own: what comes after is on record, but not what is claimed of."""
    start_error: float | None = None
    """What the input was from Kx, scaled, until the plant felt the controller; None if it felt no
    input before."""
    void: Mapping[str, str] = {}
    """Why there is no certificate, by scope."""


@dataclass(frozen=True)
class ClaimEvaluation:
    """The claims about one run; everything is computed when it is asked for, and once.

    Args:
        record: the run's record, or that of a part of it, as of a run of its own.
        part: which part; None if it is the run.
    """

    record: RunRecord
    part: RunPart | None = None

    @cached_property
    def joined(self) -> AlignedRun:
        """The run's samples."""
        return join_all(self.record)

    @cached_property
    def certificates(self) -> list[ScenarioCertificate]:
        """The certificates of the run's scenario under its schedule."""
        if self.part is None:
            return scheduled_certificates(self.record.scenario)
        found = scheduled_certificates(self.record.scenario, self.part.start_error)
        return [
            replace(one, constants=None, floor_constants=None, void=self.part.void[one.scope])
            if one.scope in self.part.void
            else one
            for one in found
        ]

    @cached_property
    def conditions(self) -> dict[str, float | None]:
        """Largest observed value of each condition."""
        return self._observed.summary()

    @cached_property
    def _unknown(self) -> Left:
        """Since when not everything is on record, so that no claim can be held against it."""
        limit = _ANY._replace(sampling_s=self._schedule.sampling_s)
        found: list[Left] = [self._observed.left(limit, ("sampling",))]
        whole, from_s = self.record, 0.0
        if self.part is not None:
            whole, from_s = self.part.whole, self.part.from_s
        for role in LOOP_ROLES:
            holes_ns = filter(None, (life.hole_ns() for life in whole.lives(role)))
            why = f"rows of {role} are missing from the record"
            found += [(t_s, why) for ns in holes_ns if (t_s := ns * 1e-9 - from_s) >= 0]
        gaps = np.flatnonzero(~self._in_common[np.argmax(self._in_common) :])
        if len(gaps):
            since_s = float(self._t_s[np.argmax(self._in_common) + gaps[0]])
            found.append((since_s, "the controller's error is not on record, or not finite"))
        return min(filter(None, found), default=None)

    @cached_property
    def beyond_mansd(self) -> Left:
        """When more than M − 1 updates in a row had been lost, whoever lost them."""
        return self._observed.left(_ANY._replace(dropouts=self._schedule.dropouts), ("dropouts",))

    @cached_property
    def _beyond_paper(self) -> Left:
        """When the run left what the paper's theorems rest on: M − 1, and u = K x_c.

        That its trigger watches always and its network is instant, no run keeps; the claims say so.
        """
        limit = _ANY._replace(dropouts=self._schedule.dropouts)
        lost = self._observed.left(limit, ("dropouts", "watchdog", "safe input", "restart"))
        return min(filter(None, (lost, self._unknown)), default=None)

    @cached_property
    def _schedule(self) -> NetworkConditions:
        return nominal_conditions(self.record.scenario)

    @cached_property
    def _observed(self) -> ObservedConditions:
        found = read_conditions(self.record)
        if self.part is None or self.part.start_error is None:
            return found
        # What the plant felt until its new start, the certificate takes into account otherwise.
        safe, restarts = found.safe_input, found.restarts
        kept, again = safe.t_s >= found.start_s, restarts.t_s > 0
        return found._replace(
            start_s=0.0 if np.isfinite(found.start_s) else found.start_s,
            safe_input=SampledSeries(safe.t_s[kept], safe.value[kept]),
            restarts=SampledSeries(restarts.t_s[again], restarts.value[again]),
        )

    @property
    def started_s(self) -> float:
        """When the plant began to feel the controller; infinite if never."""
        return read_conditions(self.record).start_s

    def judge(self) -> list[Claim]:
        """Every claim with its verdict."""
        if not len(self.joined.t_ns) or not self._in_common.any():
            return []
        if self.record.scenario.is_acknowledged:
            return [_NO_CLAIM]
        return [*self._identity(), *self._printed(), *self._certified()]

    def envelopes(self) -> list[Envelope]:
        """The bounds, at the measurements."""
        if self.record.scenario.is_acknowledged:
            return []
        t_s = self._t_s
        found: list[Envelope] = []
        for certificate in self.certificates:
            if certificate.constants is not None:
                label = f"certified for {certificate.scope}"
                found.append(Envelope(label, "e_c", t_s, certificate.controller_error(t_s)))
                found.append(Envelope(label, "x", t_s, certificate.state(t_s)))
            if certificate.inter_event_s is not None:
                found.append(self._least_interval(label, certificate.inter_event_s))
        found.append(Envelope("bound from (I1)", "e_c", t_s, self._bounds[0], "identity"))
        if (theorem := self._theorem_2) is not None:
            alpha = self.record.scenario.decaying.alpha_per_s
            state = theorem.state(t_s, alpha)
            found.append(Envelope("Theorem 2 (eq:normXt)", "x", t_s, state, "printed"))
            least = self._least_interval("Theorem 2 (eq:tau)", theorem.inter_event_s)
            found.append(least._replace(kind="printed"))
        return found

    def _least_interval(self, label: str, interval_s: float) -> Envelope:
        ends_s = np.array([0.0, self.record.scenario.horizon_s])
        return Envelope(label, "inter_event", ends_s, np.full(2, interval_s))

    @cached_property
    def _t_s(self) -> Reals:
        return np.asarray(self.joined.t_ns * 1e-9)

    @cached_property
    def _in_common(self) -> NDArray[np.bool_]:
        """Where sensor and controller have something in common: from the first delivery on."""
        common = in_common(self.record.scenario, self.joined)
        return np.asarray(np.isfinite(self.joined.e_c_norm) & common)

    @cached_property
    def _bounds(self) -> tuple[Reals, Reals]:
        """The identity's and the printed bound of ‖e_c‖_W, (k,) each; NaN before the start."""
        monitor = ErrorMonitor(self.record.loop.H, policy_of(self.record.scenario))
        rows = self.record[SENSOR_MEASUREMENT]
        found = np.array(
            [
                monitor.sample(int(t_ns), e_s, int(event), int(received))
                for t_ns, e_s, event, received in zip(
                    rows["t_ns"], rows["x_s"] - rows["x"], rows["event"], self.joined.received,
                    strict=True,
                )
            ]
        ).reshape(-1, 2)  # fmt: skip
        found[~self._in_common] = np.nan
        return found[:, 0], found[:, 1]

    @cached_property
    def _theorem_2(self) -> Theorem2 | None:
        """With the uniform Δ of (I1) under the paper's conditions, which Theorem 1 lacks."""
        scenario = self.record.scenario
        if not scenario.is_certifiable:
            return None
        ideal = certify(scenario, ideal_conditions(scenario)).constants
        if ideal is None or ideal.rate_per_s != scenario.decaying.alpha_per_s:
            return None
        if self.record.loop.weight is not None or scenario.decaying.floor > 0:
            return None
        return theorem_2(
            self.record.loop, scenario.decaying.beta, scenario.decaying.alpha_per_s, ideal.delta
        )

    @cached_property
    def _inter_event_s(self) -> tuple[Reals, Reals]:
        """Times of the events from the second on, and since the one before."""
        rows = self.record[SENSOR_MEASUREMENT]
        event_ns = rows["t_ns"][rows["event"] != NO_SEQUENCE]
        return event_ns[1:] * 1e-9, np.diff(event_ns) * 1e-9

    def _identity(self) -> Iterator[Claim]:
        here, margin = self._in_common, self._identity_margin()
        residual = identity_residual(self.record, self.joined)[here]
        # Both models were rounded: what was missed may have carried x_c far from x_s.
        there = self._t_s < self._until_s
        both = np.concatenate([self.joined.x_s[there], self.joined.x_c[here & there]])
        scale = max(float(np.abs(both).max(initial=0.0)), np.finfo(float).tiny)
        yield self._upper(
            "the models differ by what was missed", "(I1)",
            "x_c − x_s = Σ e^(H(t−t_k)) e_s(t_k), to {:.0e} of the larger", margin,
            self._t_s[here], residual / (margin * scale), self._unknown, "",
        )  # fmt: skip
        known = self.record.scenario.knows_state
        yield self._controller_error(
            "the controller's error is at most what was missed"
            + ("" if known else ", against what the sensor takes for x"), "(I1)",
            f"‖{'e_c' if known else 'x_c − x̂'}‖ ≤ ‖e_s‖ + Σ ‖e^(H(t−t_k)) e_s(t_k)‖",
            None, self._bounds[0], self._unknown, "",
        )  # fmt: skip

    def _identity_margin(self) -> float:
        """What rounding may amount to, relative to the states.

        Where e^{Hτ} grows before it decays, it makes rounding grow with it, n ε sup‖e^{Hτ}‖ in the
        time between two deliveries; but of a millionth is said that it is none.
        """
        loop, period_ns = self.record.loop, self.record.scenario.measurement_period_ns
        fresh_ns = self.joined.t_ns[np.flatnonzero(np.diff(self.joined.received, prepend=-1))]
        ends_ns = np.append(fresh_ns, self.joined.t_ns[-1])
        longest_ns = int(np.diff(ends_ns).max(initial=0))
        growth, age_ns, moved = 1.0, period_ns, transition(loop.H, period_ns)
        while age_ns <= longest_ns and growth < 1 / np.finfo(float).eps:
            growth = max(growth, float(np.linalg.norm(moved)))
            age_ns, moved = 2 * age_ns, moved @ moved
        rounding = loop.n * float(np.finfo(float).eps) * growth
        return max(_IDENTITY, min(rounding, _LARGEST_IDENTITY))

    def _printed(self) -> Iterator[Claim]:
        # An estimate, or noise, jumps at every measurement: no trigger keeps e_s below a threshold.
        if not self.record.scenario.is_decaying or not self.record.scenario.knows_state:
            return
        ideal = (
            "assumes a continuous trigger, and a network and input without delay, which no sampled "
            "loop has"
        )
        left, until_s = self._beyond_paper, self._until_s
        yield self._controller_error(
            "the paper's bound, line by line", "eq:LossEv3",
            "‖e_c‖ ≤ βe^(−αt) + Σ βe^(−αt_k) ‖e^(H(t−t_k))‖", None, self._bounds[1],
            self._unknown, ideal,
        )  # fmt: skip
        if not self.record.scenario.is_certifiable:
            return
        trigger = self.record.scenario.decaying
        delta = theorem_one(self.record, self.joined, min(until_s, left[0]) if left else until_s)
        if delta is not None and trigger.floor == 0:
            name = "Theorem 1" if self.record.loop.H.any() else "Theorem 3"
            level = trigger.beta * np.exp(-trigger.alpha_per_s * self._t_s)
            yield self._controller_error(
                "the controller's error decays", f"{name}, Δ from this run's trajectory",
                "‖e_c‖ ≤ {:.4g} βe^(−αt)", delta, delta * level, left, ideal,
            )  # fmt: skip
        if (theorem := self._theorem_2) is not None:
            bound = theorem.state(self._t_s, trigger.alpha_per_s)
            yield self._state("Theorem 2, eq:normXt", "‖x‖ ≤ c x₀ e^(−ᾱt) + g (e^(−αt) − e^(−ᾱt))",
                              None, bound, left, ideal)  # fmt: skip
            yield self._spacing("Theorem 2, eq:tau", theorem.inter_event_s, left, ideal)

    def _certified(self) -> Iterator[Claim]:
        for certificate in self.certificates:
            if certificate.constants is None:
                yield Claim(
                    f"a certificate for {certificate.scope}", certificate.source, "none",
                    None, None, None, ClaimVerdict.VOID, 0.0, certificate.void or "",
                )  # fmt: skip
                continue
            left = self._observed.left(certificate.conditions)
            if certificate.scope != OWN_PLANT and (outside := outside_box(self.record.scenario)):
                left = (0.0, outside)
            constants, t_s, source = certificate.constants, self._t_s, certificate.source
            rate = f"e^(−{constants.rate_per_s:.3g}t)" if constants.rate_per_s else ""
            late, then = certificate.floor_constants, f", from {certificate.floor_from_s:.4g} s on "
            of_s, of_c, of_x = ("", "", "") if late is None else (
                f"{then}{late.overshoot:.4g} ε", f"{then}{late.delta:.4g} ε",
                f"{then}{late.state:.4g}",
            )  # fmt: skip
            yield self._upper(
                "the sensor's error follows its threshold", source,
                f"‖e_s‖ ≤ {{:.4g}} {certificate.level}{of_s}", constants.overshoot,
                t_s, self.joined.e_s_norm / certificate.sensor_error(t_s), left, "",
            )  # fmt: skip
            yield self._controller_error(
                "the controller's error is bounded", source,
                f"‖e_c‖ ≤ {{:.4g}} {certificate.level}{of_c}", constants.delta,
                certificate.controller_error(t_s), left, "",
            )  # fmt: skip
            yield self._state(
                source, f"‖x‖ ≤ {{:.4g}} {rate}".rstrip() + of_x, constants.state,
                certificate.state(t_s), left, "",
            )  # fmt: skip
            if certificate.inter_event_s is not None:
                yield self._spacing(source, certificate.inter_event_s, left, "")

    def _controller_error(
        self, what: str, source: str, bound: str, certified: float | None, values: Reals,
        left: Left, why: str,
    ) -> Claim:  # fmt: skip
        here = self._in_common
        left = min(filter(None, (left, self._unknown)), default=None)
        # Rounding of x itself, where a bound is as small as that.
        slack = _ROUNDING * row_norms(self.joined.x[here])
        shares = _shares(self.joined.e_c_norm[here], values[here] + slack)
        return self._upper(what, source, bound, certified, self._t_s[here], shares, left, why)

    def _state(
        self, source: str, bound: str, certified: float | None, values: Reals,
        left: Left, why: str,
    ) -> Claim:  # fmt: skip
        shares = _shares(row_norms(self.joined.x), values)
        what = "the state is bounded and decays" if "e^" in bound else "the state is bounded"
        return self._upper(what, source, bound, certified, self._t_s, shares, left, why)

    def _spacing(self, source: str, certified_s: float, left: Left, why: str) -> Claim:
        t_s, passed_s = self._inter_event_s
        claim = self._upper(
            "events keep their distance", source, "t_(i+1) − t_i ≥ {:.4g} s", certified_s,
            t_s, certified_s / passed_s, left, why,
        )  # fmt: skip
        ratio = claim.ratio
        return claim._replace(observed=certified_s / ratio if ratio else None)

    @property
    def _until_s(self) -> float:
        return math.inf if self.part is None else self.part.until_s

    def _upper(
        self, what: str, source: str, bound: str, certified: float | None, t_s: Reals,
        shares: Reals, left: Left, why: str,
    ) -> Claim:  # fmt: skip
        """Judge a bound over the time of which it is claimed."""
        kept = t_s < self._until_s
        left = None if left is not None and left[0] >= self._until_s else left
        return _upper(what, source, bound, certified, t_s[kept], shares[kept], left, why)


def _shares(observed: Reals, bound: Reals) -> Reals:
    """How much of a bound was used, (k,); of a bound that is 0 itself, 0 uses nothing."""
    used = np.zeros(len(observed))
    return np.divide(observed, bound, out=used, where=(observed != 0) | ~(bound >= 0))


def _upper(
    what: str, source: str, bound: str, certified: float | None, t_s: Reals, shares: Reals,
    left: Left, why: str,
) -> Claim:  # fmt: skip
    """Judge a bound from the share of it that was used, (k,), at times (k,).

    ``why`` is the assumption of the claim that this run does not meet; empty if there is none.
    """
    text = bound.format(certified) if certified is not None else bound
    until_s = math.inf if left is None else left[0]
    judged = shares[t_s < until_s]
    beyond = np.flatnonzero(~(judged <= 1 + _ROUNDING))
    ratio = float(judged.max()) if len(judged) else None
    if len(beyond):
        verdict = ClaimVerdict.NOT_APPLICABLE if why else ClaimVerdict.VIOLATED
        since_s = float(t_s[beyond[0]])
    elif left is not None:
        verdict, since_s = ClaimVerdict.VOID, until_s
        why = "; ".join(filter(None, [why, left[1]]))
    else:
        verdict, since_s = ClaimVerdict.HELD, None
    observed = None if certified is None or ratio is None else certified * ratio
    return Claim(what, source, text, certified, observed, ratio, verdict, since_s, why)


def scheduled_certificates(
    scenario: Scenario, start_error: float | None = None
) -> list[ScenarioCertificate]:
    """The certificates of a resolved scenario under its own schedule, with its allowance.

    There are none of what is beyond the theory.

    Args:
        scenario: the scenario.
        start_error: of a run that begins with the input of an earlier one; see ``Scope``.
    """
    if not scenario.is_certifiable:
        return []
    conditions, error = allowed_conditions(scenario), 0.0
    if start_error is not None:
        conditions, error = conditions._replace(start_s=0.0), start_error
    found = [certify(scenario, conditions, error), certify_box(scenario, conditions, error)]
    return [certificate for certificate in found if certificate is not None]


def as_json(claims: Sequence[Claim]) -> list[dict[str, Any]]:
    """As ``summary.json`` has it; what is not finite becomes null."""
    return [{key: _plain(value) for key, value in claim._asdict().items()} for claim in claims]


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return str(value) if isinstance(value, StrEnum) else value
