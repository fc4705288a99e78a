"""The words of a comparison of a run with its loop document."""

from collections.abc import Callable, Mapping

from cosim.analysis.conformance.verdicts import EdgeKind, Failed
from cosim.analysis.summary.summary_model import ConformancePart, FailurePart
from netem.core.number_format import counted, duration, percent

_READINGS = {
    "x": "the state is not the recorded one",
    "x_s": "the sensor's model is not the recorded one",
    "x_c": "the controller's model, from which the applied input was computed, is not the recorded one",
}
"""What differs, by the name of a reading."""
_FACTS = {
    "silent": "the sensor sent no packet, although its comparison exceeds the threshold",
    "event": "the sensor sent a packet, although its comparison is below the threshold",
    "event, level": "the sensor sent a packet, although its comparison is below the threshold",
    "event, floor": "the sensor sent a packet, although its comparison is below the threshold",
}
"""What failed, by the name of a fact."""


def conformance_text(part: ConformancePart) -> str:
    """Return in one sentence whether a run is a run of a document, and what this says."""
    if not part.document:
        return f"no loop document describes this loop: {part.missing}"
    taken = f"{part.transitions_taken} of the document's {part.transitions} kinds of transitions occurred"
    if part.share < 1:
        taken += f"; the motion was compared at {percent(part.share)} of the steps"
    if part.failure is None:
        return (
            f"the run is a run of the loop document {part.document!r}, so the bounds that are proved of this "
            f"document hold for the run; {taken}"
        )
    return (
        f"the run is a run of the loop document {part.document!r} until {part.until_s or 0.0:.6g} s only: "
        f"{failure_text(part.failure)}; the bounds that are proved of this document hold until then; {taken}"
    )


def failure_text(failure: FailurePart) -> str:
    """Return in words what of a run is not as its document says."""
    return _TEXTS[failure.kind](failure)


def _edge_text(failure: FailurePart) -> str:
    then, most = failure.then, failure.most
    if then is None or failure.happened is None:
        return f"a transition {failure.place!r} happened, which the document does not have here"
    if failure.happened is EdgeKind.SILENT:
        return "a packet had not taken effect by the next test, which is later than the document allows"
    if most is None or then.number <= most:
        event = "a packet was sent" if failure.happened is EdgeKind.EVENT else "a packet took effect"
        return f"{event}, which the document does not allow at {failure.place!r}"
    limit = f"at most {most} {'is' if most == 1 else 'are'} allowed"
    count = f"{counted(then.number, 'packet')} {'was' if then.number == 1 else 'were'}"
    if then.waits:
        return f"{count} sent while another one was on its way, {limit}"
    return f"{count} lost in a row, {limit}"


def _clock_text(failure: FailurePart) -> str:
    at, found, high = failure.at, _time(failure.found_s), _time(failure.high_s)
    if at is None or failure.kind is Failed.CLOCK:
        return f"the clock of {failure.place!r} differs from the clock of the record"
    if failure.found_s is not None and failure.low_s is not None and failure.found_s < failure.low_s:
        return f"a test came {found} after the one before, at least {_time(failure.low_s)} are required"
    if at.waits and at.starts:
        return f"the first input had not taken effect by {found}, at most {high} is allowed"
    if at.waits:
        return f"a packet had not taken effect {found} after it was sent, at most {high} is allowed"
    return f"the trigger was not tested for {found}, at most {high} is allowed"


def _time(time_s: float | None) -> str:
    return "an unknown time" if time_s is None else duration(time_s)


def _fact_text(failure: FailurePart) -> str:
    return _FACTS.get(failure.detail, f"the fact {failure.detail!r} of the document does not hold")


def _input_text(failure: FailurePart) -> str:
    if failure.at is not None and failure.at.starts:
        return "an input acted before the first one of a controller with a state"
    age_s = failure.input_age_s
    if age_s is None:
        return "the applied input is none that the document allows"
    if age_s < 0:
        return f"the applied input was computed for a time {_time(-age_s)} after its step"
    return f"the applied input is none that the document allows; it was {_time(age_s)} old at its step"


_TEXTS: Mapping[Failed, Callable[[FailurePart], str]] = {
    Failed.PATH: lambda failure: failure.detail,
    Failed.EDGE: _edge_text,
    Failed.WHEN: _clock_text,
    Failed.CLOCK: _clock_text,
    Failed.LIMIT: _clock_text,
    Failed.FACT: _fact_text,
    Failed.JUMP: lambda failure: f"the state is another one after {failure.place!r}",
    Failed.ZERO: lambda failure: f"a coordinate is not 0 in {failure.place!r}",
    Failed.MOTION: lambda _: "the state moved in a way in which no plant of the document moves",
    Failed.INPUT: _input_text,
    Failed.READING: lambda failure: _READINGS.get(failure.detail, "the record shows another state"),
}
"""The words of a failure, by its kind."""
