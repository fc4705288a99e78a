"""Sections of a report: the difference from the ideal loop, and the replay."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from cosim.analysis.fidelity import is_against
from cosim.analysis.summary_model import ReplayDifference
from noack.core.number_format import percent

FIDELITY, REPLAY = "Fidelity", "Replay"

_EFFECTS = {
    "sampling": "the trigger is tested at the measurements only",
    "delay": "updates arrive late, and act at the controller's next tick",
    "held_actuation": "the plant holds each input until the next one arrives",
    "residual": "the rest, which should be rounding only",
}
"""The effects that ``noack fidelity`` adds to the ideal loop, in order."""


class ReportFinding(NamedTuple):
    """A section of the report."""

    heading: str
    paragraphs: list[str]
    rows: list[tuple[str, str, str]]
    """Effect, its meaning, its share of the difference."""


def findings(summary: Mapping[str, Any]) -> Iterator[ReportFinding]:
    """Yield the sections for which the summary has data."""
    if fidelity := summary.get("fidelity"):
        yield ReportFinding(FIDELITY, list(_fidelity(fidelity)), list(_effects(fidelity)))
    if replay := summary.get("replay"):
        yield ReportFinding(REPLAY, list(_replay(replay)), [])


def _fidelity(found: Mapping[str, Any]) -> Iterator[str]:
    if found.get("reason") is not None or found.get("rms_x") is None:
        yield f"Not compared with the ideal loop: {found.get('reason') or 'no reason is known'}."
        return
    scale = found["rms_x_live"]
    of_x = f", {100 * found['rms_x'] / scale:.2g} % of x itself" if scale else ""
    yield (
        "The ideal loop is the paper's: its trigger is tested continuously and its updates act at "
        "once. It loses the same packets as this run. The two differ in x by "
        f"{found['rms_x']:.3g} (RMS){of_x}, and by at most {found['max_x']:.3g}."
    )
    residual = f"the residual is {100 * found['explained_relative']:.2g} % of the difference"
    yield (
        f"The effects below explain the difference: {residual}."
        if found["explained"]
        else f"The effects below do not explain the difference: {residual}, which is too large."
    )
    yield _events(found)
    if any(map(is_against, found["shares"].values())):
        yield ("An effect with a negative share partly cancels the others.")


def _events(found: Mapping[str, Any]) -> str:
    counts = f"{found['events_live']} events, the ideal loop {found['events_ideal']}"
    if (parted := found["first_different_event"]) is not None:
        return (
            f"The run had {counts}. They agree up to event {parted}; from there on, the losses "
            "fall on other events."
        )
    if (apart_s := found["max_event_difference_s"]) is None:
        return f"The run had {counts}."
    return f"The run had {counts}; the times of an event differ by at most {1e3 * apart_s:.3g} ms."


def _effects(found: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    for name, share in (found.get("shares") or {}).items():
        yield name.replace("_", " "), _EFFECTS.get(name, ""), percent(share)


def _replay(found: Mapping[str, Any]) -> Iterator[str]:
    if found["bit_exact"] is None:
        yield f"Nothing could be replayed: {found.get('error', 'the record is empty')}."
    elif found["bit_exact"]:
        yield (
            f"The {found['inputs']:,} recorded inputs were replayed: the outputs equal the record, "
            "bit for bit."
        )
    else:
        yield (
            "The recorded inputs were replayed: an output differs from the record: "
            f"{ReplayDifference(**found['first_difference'])}."
        )
    if not found.get("complete", True):
        yield "The record has gaps, which could not be compared."
