"""The summary of a run, ``summary.json``, as a model; ``docs/record.md`` explains the keys."""

import math
from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)

from cosim.analysis.conformance.verdicts import Conformance, EdgeKind, Failed
from netem.core.errors import CallerError, ExitStatus
from netem.core.number_format import at_least, at_most
from noack.scenario.scenario import few_of


def _or_none(value: object) -> object:
    """Return None for infinity and NaN, which JSON does not have."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


Count = Annotated[int, Field(ge=-(2**63), lt=2**63)]
Real = Annotated[float | None, BeforeValidator(_or_none)]
Counts = dict[str, Count]
Matrix = Annotated[list[Annotated[list[float], Field(min_length=1)]], Field(min_length=1)]


class SummaryPart(BaseModel):
    """A part of a summary, validated when it is created and when it is read."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)


class ViolationPart(SummaryPart):
    """What a process reported during the run: losses beyond the guarantee, or a change that came late."""

    t_s: float
    process: str
    cause: str
    what: str


class Quantiles(SummaryPart):
    """Quantiles of wall times in µs."""

    p50: Real
    p99: Real
    p999: Real
    max: Real


class LatenessPart(Quantiles):
    """The lateness of a process."""

    steps: Count
    late_steps: Count


class LatencyPart(Quantiles):
    """Time from an event to the controller's update."""

    updates: Count


class FlowPart(SummaryPart):
    """The outcome of acknowledgements or actuations in the network."""

    sent: Count
    lost: Count
    longest_loss_burst: Count
    received: Count


class WatchdogPart(SummaryPart):
    """The number of times that the plant's watchdog acted."""

    policy: str
    timeout_s: float
    trips: Count
    first_s: Real
    total_s: float


class EstimationPart(SummaryPart):
    """The sensor's estimation error."""

    observer: str | None
    outputs: Count
    noise_std: list[float]
    rms: Real
    rms_second_half: Real
    expected_rms: Real
    max: Real
    sup_e_c_norm: Real


class DisturbancePart(SummaryPart):
    """The disturbances at one place."""

    at: str
    kinds: list[str]
    rms: Real
    max: Real


class ReplayDifference(SummaryPart):
    """A value that differs between record and replay.

    Floating-point values also have their ``float.hex()``, which shows every bit; a value that is
    not finite has this form only.
    """

    table: str
    row: Count
    """Index in the table, from 0."""
    column: str
    """Name as in the Parquet file, such as ``x_2``; empty if no single column differs."""
    recorded: Count | float | str | None
    recorded_hex: str | None
    replayed: Count | float | str | None
    replayed_hex: str | None
    what: str
    """The difference in words."""
    now_ns: Count
    """The row's recorded time."""

    def __str__(self) -> str:
        column = f", {self.column}" if self.column else ""
        values = ""
        if self.recorded is not None or self.recorded_hex is not None:
            recorded = _value_text(self.recorded, self.recorded_hex)
            replayed = _value_text(self.replayed, self.replayed_hex)
            values = f": recorded {recorded}, replayed {replayed}"
        return f"{self.table} row {self.row}{column}: {self.what}{values}"


def _value_text(value: float | str | None, as_hex: str | None) -> str:
    if value is None:
        return as_hex or "nothing"
    return f"{value} ({as_hex})" if as_hex else str(value)


class ReplayPart(SummaryPart):
    """The result of the replay."""

    bit_exact: bool | None
    complete: bool = True
    inputs: Count = 0
    first_difference: ReplayDifference | None = None
    error: str | None = None

    @model_validator(mode="after")
    def _names_the_difference(self) -> Self:
        if self.bit_exact is False and self.first_difference is None:
            raise ValueError("a replay that is not bit-exact has a first difference")
        return self


class IdealLoopPart(SummaryPart):
    """The ideal loop, and the difference of the run's states to its states."""

    reason: None
    rms_difference: float
    """Root mean square of ‖x − x_ideal‖ over all steps of the plant."""
    rms_x: float
    """The same of ‖x‖ in the run."""
    events: Count
    """Transmissions of the ideal loop."""


class NoIdealLoopPart(SummaryPart):
    """Why the run was not compared with the ideal loop."""

    reason: str


class LinearisationPart(SummaryPart):
    """A plant that is not linear, at its operating point."""

    A: Matrix
    B: Matrix
    eigenvalues: Annotated[
        list[Annotated[list[float], Field(min_length=2, max_length=2)]], Field(min_length=1)
    ]
    off_A: Matrix
    off_B: Matrix
    in_box: bool | None


class NoLinearisationPart(SummaryPart):
    """A plant without a linearisation."""

    A: None


class PlacePart(SummaryPart):
    """What the name of a location of a loop document says."""

    starts: bool
    """No input acts yet."""
    waits: bool
    """An update is on its way that will act."""
    number: Count
    """So many updates were sent after it; or so many are lost, if none is on its way."""


class FailurePart(SummaryPart):
    """What of a run is first not as its loop document says."""

    kind: Annotated[Failed, Field(strict=False)]
    place: str
    """The location or the edge of the document."""
    detail: str
    """The name of a fact or of a reading."""
    found_s: Real = None
    """What a clock showed."""
    low_s: Real = None
    high_s: Real = None
    """What it may show."""
    at: PlacePart | None = None
    """The location, or that from which the edge leads."""
    happened: Annotated[EdgeKind | None, Field(strict=False)] = None
    """What happened there, for which the document has no edge."""
    then: PlacePart | None = None
    """Where this would have led."""
    most: Count | None = None
    """The largest number that the document has for this."""
    input_age_s: Real = None
    """The age of the input at this time."""


class ConformancePart(SummaryPart):
    """Whether the run is a run of the loop document of a certificate."""

    certificate: str
    """The source of the claims whose bounds are proved of this document."""
    document: str
    """Its name; empty: no document describes the loop."""
    missing: str = ""
    """Why there is no document."""
    until_s: Real = None
    """The run is one of the document up to this time; None: to its end, or there is no document."""
    failure: FailurePart | None = None
    """What failed then."""
    transitions: Count = 0
    """So many edges the document has."""
    transitions_taken: Count = 0
    """So many of them the run took."""
    share: float = 1.0
    """Of the steps, so many were compared in all numbers; edges, clocks and times always are."""

    @classmethod
    def of(cls, found: Conformance, certificate: str) -> Self:
        """Return the part of a result."""
        failure, place = found.failure, None
        if failure is not None:
            unknown = failure.unknown
            place = FailurePart(
                kind=failure.kind,
                place=failure.place,
                detail=failure.detail,
                found_s=failure.found,
                low_s=failure.low,
                high_s=failure.high,
                at=None if failure.at is None else PlacePart(**failure.at._asdict()),
                happened=None if unknown is None else unknown.transition.kind,
                then=None if unknown is None else PlacePart(**unknown.transition.target._asdict()),
                most=None if unknown is None or unknown.most < 0 else unknown.most,
                input_age_s=failure.input_age_s,
            )
        return cls(
            certificate=certificate,
            document=found.document,
            until_s=None if failure is None else failure.t_s,
            failure=place,
            transitions=len(found.edges),
            transitions_taken=sum(count > 0 for count in found.edges.values()),
            share=found.share,
        )


class ClaimVerdict(StrEnum):
    """The result of checking a claim against a run."""

    HELD = "held"
    VIOLATED = "violated"
    ENDED = "ended"
    """The bound held until ``since_s``, and nothing is claimed from then on: the cause says why."""
    UNCHECKED = "unchecked"
    """Nothing was compared: there is no bound, or no document to compare the run with."""
    NOT_APPLICABLE = "not applicable"
    """The bound was exceeded, but no sampled loop meets the claim's assumptions: this run does not
    refute it."""


class ClaimCause(StrEnum):
    """Why a claim ended, or was not checked. The words are in ``cosim/output/claim_words.py``."""

    CONFORMANCE = "conformance"
    """The run is not one of the loop document from then on."""
    NO_DOCUMENT = "no document"
    """No document describes the loop, so that no run can be compared with it."""
    NO_CERTIFICATE = "no certificate"
    CHANGED = "changed"
    """Settings changed before anything could be compared."""
    OUTSIDE = "outside"
    """The plant is outside of its uncertainty."""
    MISSING_ROWS = "missing rows"
    """Rows of a process are missing from the record."""
    MISSING_MEASUREMENT = "missing measurement"
    NO_ERROR = "no error"
    """The controller's error is not on record, or not finite."""
    CLOCK = "clock"
    """A message was received before it was sent, by more than the bounds of the clocks explain."""
    SETPOINTS = "set-points"
    """Sensor and controller took the change of the set-point at different times."""
    ROUNDING = "rounding"
    """The threshold is below the rounding error of x at the set-point."""
    LOSSES = "losses"
    """Losses beyond the guarantee."""
    WATCHDOG = "watchdog"
    """The watchdog replaced the input."""
    SAFE_INPUT = "safe input"
    """The controller had no state and sent its safe input."""
    ACKNOWLEDGED = "acknowledged"
    """x_s is reset when an update is acknowledged."""
    IDEAL_LOOP = "ideal loop"
    """The claim assumes a loop that is not sampled, without delays."""


NO_BOUND = "none"
"""The formula of a claim that has no bound."""


class ClaimKind(StrEnum):
    """What a claim follows from."""

    CERTIFICATE = "certificate"
    """It is proved of the loop document of a certificate, and holds as long as the run conforms to it."""
    GUARANTEE = "guarantee"
    """It is a rule of the network's guarantee."""
    IDENTITY = "identity"
    """It follows from the definitions of the loop, as (I1) does."""
    PAPER = "paper"
    """It is a bound of the paper, computed, which assumes an ideal loop."""


class Claim(SummaryPart):
    """A claim, checked against the run."""

    what: str
    kind: Annotated[ClaimKind, Field(strict=False)]
    source: str
    bound: str
    """The claim as a formula with its numbers."""
    certified: Real
    """The claimed constant."""
    observed: Real
    """The smallest constant with which the claim holds for this run."""
    ratio: Real
    """Largest share of the bound that was reached; at most 1 if the claim held."""
    verdict: Annotated[ClaimVerdict, Field(strict=False)]
    since_s: Real
    """Time from which the claim was violated, ended or not applicable."""
    cause: Annotated[ClaimCause | None, Field(strict=False)] = None
    """Why it ended, was not checked or is not applicable."""
    detail: str = ""
    """The process, the rule or the reason that the cause is about."""
    until_s: Real
    """The claim ends here, at the first change of a setting on which it depends; None: at the end of
    the run."""
    proved: bool | None = None
    """Whether the checker has proven the bound, as that of a certificate. None: it follows from the
    definitions of the loop, or there is no bound."""
    quantity: str | None = None
    """What is bounded: ``"e_c"``, ``"e_s"``, ``"estimate"``, ``"x"``, ``"region"``, ``"inter_event"``,
    ``"losses"`` or ``"output"``; None: nothing of these."""
    output: str | None = None
    """The output that is bounded, by its name; None: something else is."""
    settles_s: Real = None
    """From when on the output stays within its allowed error; None: this is not claimed."""

    @property
    def origin(self) -> str:
        """The source, and how the bound is known; the identity (I1) is a definition."""
        if self.proved:
            return f"{self.source} (proved)"
        return f"{self.source} (computed)" if self.kind is ClaimKind.PAPER else self.source

    @property
    def is_certified(self) -> bool:
        """Whether it is a claim of a certificate; others follow from the definitions of the loop."""
        return self.kind is ClaimKind.CERTIFICATE

    @property
    def has_bound(self) -> bool:
        """Whether there is a bound; else the cause says why there is none."""
        return self.bound != NO_BOUND

    @property
    def lacks_certificate(self) -> bool:
        """Whether there is no certificate."""
        return self.is_certified and not self.has_bound

    @property
    def is_lower_bound(self) -> bool:
        """Whether the claimed constant is a lower bound."""
        return self.quantity == "inter_event"

    @property
    def certified_text(self) -> str | None:
        """The claimed constant, rounded up, or down if it is a lower bound."""
        if self.certified is None:
            return None
        return at_least(self.certified) if self.is_lower_bound else at_most(self.certified)


class ConditionsPart(SummaryPart):
    """The longest loss burst, and the largest times of the loop that occurred."""

    dropouts: Real
    sampling_s: Real
    delay_s: Real
    hold_s: Real
    lead_s: Real = None
    start_s: Real
    clock_error_s: Real = None


class AllowedConditionsPart(SummaryPart):
    """Times that are allowed, or that a proof covers, as in :class:`ConditionsPart`."""

    sampling_s: float
    delay_s: float
    hold_s: float
    lead_s: float = 0.0
    start_s: float


class ChangePart(SummaryPart):
    """A change of settings during the run."""

    number: Count
    t_s: float
    settings: dict[str, object]
    what: str
    in_force_from_s: dict[str, float]


class ExitPart(SummaryPart):
    """How the run, or a loop, ended."""

    status: Annotated[Count, AfterValidator(lambda status: int(ExitStatus(status)))]
    reason: str


class OutputPart(SummaryPart):
    """An output that the scenario states: its distance from its set-point or reference during the run."""

    name: str
    unit: str
    allowed: Real
    """The allowed error; None: nothing is asked."""
    target: Literal["set-point", "reference"] | None
    """What it is to follow; None: the controller's law has a set-point of its own, which noack does not
    know. Distances are then those from 0."""
    largest: Real
    last: Real
    settled_s: Real
    """From when on the output stayed within the allowed error; None: it was not within at the end,
    or its target is not known."""


class LoopSummary(SummaryPart):
    """A loop of the run; times are its own, which are 0 at its phase."""

    name: str
    number: Count
    phase_s: float
    """Time of the run at which the loop begins."""
    mode: str
    reached_s: float
    events: Count
    deliveries: Count
    drops: Count
    loss_expected: Real
    drops_by_cause: Counts
    forced_deliveries: Count
    longest_loss_burst: Count
    loss_bursts: Counts = {}
    link_share: Real
    """Share of the bytes that the network forwarded."""
    delay_mean_s: Real
    """Mean time of a forwarded datagram in the network."""
    delay_max_s: Real
    acknowledgements: FlowPart | None = None
    actuations: FlowPart | None = None
    """Only if they cross the network."""
    violations: list[ViolationPart]
    """What processes reported while the run went on."""
    uneven_periods: list[str] = []
    """What differs from the scenario's periods since they do not divide each other."""
    changes: list[ChangePart]
    missing_samples: Count
    missing_by_table: Counts
    unintended_losses: Count
    unintended_losses_by_leg: Counts
    rejected_datagrams: dict[str, Counts]
    inter_event_min_s: Real
    inter_event_median_s: Real
    inter_delivery_median_s: Real
    setpoint: list[float] | None = None
    outputs: list[OutputPart] = []
    """Those that the scenario states."""
    initial_state_norm: Real
    final_state_norm: Real
    sup_state_norm: Real
    sup_e_s_norm: Real
    sup_e_c_norm: Real
    sup_e_c_at_s: Real
    identity_residual_max: Real
    identity_residual_relative: Real
    lateness_us: dict[str, LatenessPart]
    latency_us: LatencyPart | None
    realtime: dict[str, dict[str, str]]
    watchdog: WatchdogPart
    estimation: EstimationPart | None
    disturbances: list[DisturbancePart]
    diverged_at_s: Real
    replay: ReplayPart | None = None
    """Of its processes; with the network, unless others share it or the loop begins later than the run."""
    linearisation: LinearisationPart | NoLinearisationPart | None = None
    ideal_loop: IdealLoopPart | NoIdealLoopPart | None = None
    conditions: ConditionsPart | None = None
    allowed: AllowedConditionsPart | None = None
    """The schedule that the scenario allows; None where there are no certificates."""
    certified_for: AllowedConditionsPart | None = None
    """The schedule that the certificates cover, if the run was later than its scenario allows."""
    conformance: list[ConformancePart] = []
    """For each certificate: whether the run is one of its loop document."""
    claims: list[Claim] = []
    judged_until_s: Real = None
    exit: ExitPart

    @model_validator(mode="after")
    def _has_both_timings(self) -> Self:
        if self.lateness_us and self.latency_us is None:
            raise ValueError("a live run has a latency")
        return self

    def to_json(self) -> dict[str, object]:
        """The summary as JSON."""
        return self.model_dump(mode="json")


class InFlightPart(SummaryPart):
    """Datagrams inside the network: those that wait, are sent or are delayed."""

    mean: float
    """Over the time that the run reached."""
    max: Count
    width_s: float
    """Width of the intervals of the two lists."""
    mean_by_interval: list[float]
    max_by_interval: list[Count]


class NetworkPart(SummaryPart):
    """The network of all loops, in the direction of the updates."""

    datagrams: Count
    forwarded: Count
    """Of these, some may still be in the network at the end of the run."""
    forced_deliveries: Count
    drops_by_cause: Counts
    longest_loss_burst: Count
    rate_bps: Count | None
    """The lowest rate of its bottlenecks; None without one."""
    utilisation: Real
    """Share of this rate that the datagrams used that left until the end of the run, with their
    overhead; with a duplication before the bottleneck, their copies, too."""
    in_flight: InFlightPart
    replay: ReplayPart | None = None
    """Unless it is replayed with the only loop."""


class DeadlinesPart(SummaryPart):
    """The deadlines of a process, over all loops."""

    steps: Count
    late_steps: Count
    """Late by more than a period."""
    max_us: Real
    """Largest lateness, in wall µs."""


class RunSummary(SummaryPart):
    """The content of ``summary.json``: the network, and an entry for each loop."""

    kind: Literal["live", "simulated"]
    startup_s: Real
    scenario: str
    mansd: Count
    constraints: list[str] = []
    """Further constraints of the guarantee, in the words of the settings."""
    horizon_s: float
    speed: float
    reached_s: float
    network: NetworkPart
    loops: Annotated[list[LoopSummary], Field(min_length=1)]
    """In the order of their numbers."""
    changes: list[ChangePart]
    """The changes of settings during the run, in the time of the run."""
    deadlines: dict[str, DeadlinesPart] = Field(default_factory=dict)
    """By process; empty for a simulated run."""
    exit: ExitPart

    @model_validator(mode="after")
    def _numbers_ascend(self) -> Self:
        numbers = [loop.number for loop in self.loops]
        if numbers != sorted(set(numbers)):
            raise ValueError("the numbers of the loops ascend")
        return self

    def of_loop(self, name: str) -> "RunSummary":
        """Return the summary with one loop only; it ended as this loop did.

        Raises:
            CallerError: there is no loop of this name, as in the summary of another run.
        """
        for loop in self.loops:
            if loop.name == name:
                only = {"loops": [loop], "exit": loop.exit, "changes": loop.changes}
                scenario = self.scenario if len(self.loops) == 1 else name
                return self.model_copy(update=only | {"scenario": scenario, "reached_s": loop.reached_s})
        raise CallerError(
            f"summary.json: has no loop {name}, but {few_of([loop.name for loop in self.loops])}; if it is "
            "of another run, remove it: `noack summary RUN` computes it again"
        )

    def to_json(self) -> dict[str, object]:
        """The content of ``summary.json``."""
        return self.model_dump(mode="json")


def read_summary(content: Mapping[str, object]) -> RunSummary | None:
    """Return a summary from its JSON; None if it is not complete, or of another version."""
    try:
        return RunSummary.model_validate(content)
    except ValidationError:
        return None
