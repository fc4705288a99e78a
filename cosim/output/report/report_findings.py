"""What a report says of a run's difference to the ideal loop, and of its replay."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from cosim.analysis.fidelity import is_against, percent
from cosim.analysis.replay.replay_result import ReplayDifference

FIDELITY, REPLAY = "Fidelity", "Replay"

_EFFECTS = {
    "sampling": "the trigger is tested at measurements only",
    "delay": "updates take time, and act at the controller's next tick",
    "held_actuation": "the plant holds an input until it has the next one",
    "unexplained": "what is left: rounding, if all is well",
}
"""As ``noack fidelity`` adds them to the ideal loop, one after the other."""


class ReportFinding(NamedTuple):
    """A section of the report."""

    heading: str
    said: list[str]
    """Paragraphs."""
    rows: list[tuple[str, str, str]]
    """Effect, what it is, its share of the difference."""


def findings(summary: Mapping[str, Any]) -> Iterator[ReportFinding]:
    """Return the sections of what there is of the two."""
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
        "The ideal loop is the paper's, with the packet fates of this run: it watches "
        f"continuously, and what it sends acts at once. The run's x differs from its x by "
        f"{found['rms_x']:.3g} (RMS){of_x}, and by {found['max_x']:.3g} at most."
    )
    left = f"{100 * found['explained_relative']:.2g} % of the difference"
    yield (
        f"The effects below explain it: {left} is left."
        if found["explained"]
        else f"The effects below do not explain it: {left} is left, which is too much."
    )
    yield _events(found)
    if any(map(is_against, found["shares"].values())):
        yield (
            "Effects partly cancel: one with a negative share takes away from the difference that "
            "the others make."
        )


def _events(found: Mapping[str, Any]) -> str:
    counts = f"{found['events_live']} events, against {found['events_ideal']} of the ideal loop"
    if (parted := found["first_different_event"]) is not None:
        return (
            f"The run had {counts}. With event {parted} they part: from there on the same fates "
            "meet other events."
        )
    if (apart_s := found["max_event_difference_s"]) is None:
        return f"The run had {counts}."
    return f"The run had {counts}; each at most {1e3 * apart_s:.3g} ms from the ideal one."


def _effects(found: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    for name, share in (found.get("shares") or {}).items():
        yield name.replace("_", " "), _EFFECTS.get(name, ""), percent(share)


def _replay(found: Mapping[str, Any]) -> Iterator[str]:
    if found["bit_exact"] is None:
        yield f"Nothing could be replayed: {found.get('error', 'the record is empty')}."
    elif found["bit_exact"]:
        yield (
            f"The machines were fed their {found['inputs']:,} recorded inputs again: all that they "
            "then did is what is on record, bit for bit."
        )
    else:
        yield (
            "Fed its recorded inputs again, a machine did something else than is on record: "
            f"{ReplayDifference(**found['first_difference'])}."
        )
    if not found.get("complete", True):
        yield "The record has gaps; what lies in them could not be compared."
