"""What a summary needs to be shown; one of an earlier version may lack it, a damaged one does."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

Name = Annotated[str, Field(pattern=r"^[^\[]*$")]
"""Text that a table shows as it is: without a bracket, which would begin markup."""
Reals = dict[Name, float]
Number = Annotated[int, Field(ge=-(2**63), lt=2**63)]
Counts = dict[Name, Number]
Matrix = Annotated[list[Annotated[list[float], Field(min_length=1)]], Field(min_length=1)]


class _Part(BaseModel):
    """Part of a summary; it may hold more."""

    model_config = ConfigDict(strict=True, extra="allow")


class _Assumption(_Part):
    what: str
    source: str
    verdict: str
    why: str


class _Violation(_Part):
    t_s: float
    process: Name
    what: str


class _Quantiles(_Part):
    p50: float | None
    p99: float | None
    p999: float | None
    max: float | None


class _Lateness(_Quantiles):
    steps: Number
    late_steps: Number


class _Latency(_Quantiles):
    updates: Number


class _Acknowledgements(_Part):
    sent: Number
    lost: Number
    longest_loss_burst: Number


class _Watchdog(_Part):
    policy: Name
    trips: Number
    first_s: float | None
    total_s: float


class _Estimation(_Part):
    observer: Name | None
    rms_second_half: float | None
    expected_rms: float | None
    max: float | None
    sup_e_c_norm: float | None


class _Disturbance(_Part):
    at: Name
    rms: float | None
    max: float | None


class _Difference(_Part):
    model_config = ConfigDict(extra="forbid")

    table: Name
    row: Number
    column: Name
    recorded: Number | float | str | None
    recorded_hex: str | None
    replayed: Number | float | str | None
    replayed_hex: str | None
    what: str
    now_ns: Number


class _BitExact(_Part):
    bit_exact: Literal[True]
    inputs: Number
    complete: bool = True


class _Differs(_Part):
    bit_exact: Literal[False]
    first_difference: _Difference
    complete: bool = True


class _NotReplayed(_Part):
    bit_exact: None
    complete: bool = True


class _Compared(_Part):
    reason: None
    explained: bool
    rms_x: float
    max_x: float
    rms_x_live: float
    explained_relative: float
    events_ideal: Number
    shares: Reals
    events_live: Number
    max_event_difference_s: float | None
    parted_event: Number | None


class _NotCompared(_Part):
    reason: str


class _Linearised(_Part):
    A: Matrix
    eigenvalues: Annotated[
        list[Annotated[list[float], Field(min_length=2, max_length=2)]], Field(min_length=1)
    ]
    off_A: Matrix
    off_B: Matrix
    in_box: bool | None


class _NotLinearised(_Part):
    A: None


class _Claim(_Part):
    what: str
    source: str
    bound: str
    ratio: float | None
    verdict: Literal["held", "violated", "void", "not applicable"]
    since_s: float | None
    why: str
    from_s: float = 0.0
    until_s: float | None = None


class _Changed(_Part):
    t_s: float
    what: str


class _Restart(_Part):
    process: Name
    last_s: float | None
    first_s: float | None
    what: str | None


class _Shown(_Part):
    kind: Literal["live", "simulated"]
    scenario: Name
    mode: str
    mansd: Number
    horizon_s: float
    reached_s: float
    events: Number
    deliveries: Number
    drops: Number
    drops_by_cause: Counts | None = None
    loss_expected: float | None = None
    forced_deliveries: Number
    longest_loss_burst: Number
    assumption_violations: list[_Violation]
    assumptions: list[_Assumption]
    missing_samples: Number
    missing_by_table: Counts
    lost_outside_netem: Number
    lost_by_leg: Counts
    rejected_datagrams: dict[Name, Counts]
    inter_event_min_s: float | None
    inter_event_median_s: float | None
    inter_delivery_median_s: float | None
    initial_state_norm: float | None
    final_state_norm: float | None
    sup_e_s_norm: float | None
    sup_e_c_norm: float | None
    identity_residual_relative: float | None
    lateness_us: dict[Name, _Lateness]
    latency_us: _Latency | None
    realtime: dict[str, dict[str, str]]
    acknowledgements: _Acknowledgements | None = None
    watchdog: _Watchdog | None = None
    estimation: _Estimation | None = None
    disturbances: list[_Disturbance] | None = None
    replay: _BitExact | _Differs | _NotReplayed | None = None
    fidelity: _Compared | _NotCompared | None = None
    linearisation: _Linearised | _NotLinearised | None = None
    claims: list[_Claim] | None = None
    changes: list[_Changed] | None = None
    restarts: list[_Restart] | None = None


def can_be_shown(summary: Mapping[str, Any]) -> bool:
    """Whether a summary has all that is shown of it, and of the right kind."""
    try:
        shown = _Shown.model_validate(summary)
    except ValidationError:
        return False
    return shown.latency_us is not None or not shown.lateness_us
