"""What the page and the explorer show, computed by the library: a run, its certificate, its margin.

All of it can be computed in another process: arguments and results are plain data.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import noack
from noack.extend import CallerError

ERRORS, NORM, INTERVALS = "error norms", "norm of the state", "inter-event time"
"""Panels of the curves; see :class:`noack.Curve`."""
EXACT, SIMULATED, LIVE, RECORDED = "exact", "in virtual time", "live", "recorded"
MOST_EVENTS = 3000
"""Most transmissions of an exact run, so that dragging stays quick."""
_POINTS = 121
"""Times at which certified bounds are drawn."""
_GREEN, _DASHED = (51, 162, 78), (6.0, 2.5)
_MARGIN_ACCURACY = 1e-3
_CONTINUOUS = "in continuous time: "
_OUTPUT = "output "
"""What the name of the panel of an output's distance begins with."""


class VerdictText(NamedTuple):
    """A line of a verdict; its tone is good, doubt, bad or empty."""

    text: str
    tone: str = ""


class Fact(NamedTuple):
    """A key number in words."""

    label: str
    value: str


@dataclass(frozen=True)
class ShownRun:
    """A run as the page shows it."""

    kind: str
    """EXACT, SIMULATED, LIVE or RECORDED."""
    curves: list[noack.Curve]
    verdict: list[VerdictText] = field(default_factory=list)
    note: str = ""
    loops: tuple[str, ...] = ()
    """Names of the loops of a recorded run."""
    end_s: float | None = None
    """End of the axis of time; None: the last time that is drawn."""

    @property
    def states(self) -> list[str]:
        """The names of the states."""
        plants = (curve.panel for curve in self.curves if curve.name == "x plant")
        return [*dict.fromkeys(panel for panel in plants if not panel.startswith(_OUTPUT))]

    @property
    def transmissions(self) -> NDArray[np.bool_]:
        """Whether each transmission was delivered, (k,) in the order of their times."""
        names = (INTERVALS, "delivered"), (INTERVALS, "lost")
        parts = [curve for curve in self.curves if (curve.panel, curve.name) in names]
        t_s = np.concatenate([np.zeros(0), *(curve.t_s for curve in parts)])
        arrived = [np.full(len(curve.t_s), curve.name == "delivered") for curve in parts]
        return np.concatenate([np.zeros(0, np.bool_), *arrived])[np.argsort(t_s, kind="stable")]

    def values(self, panel: str, name: str) -> NDArray[np.float64]:
        """Return the values of a curve that are known, in the order of their times."""
        curves = (curve for curve in self.curves if (curve.panel, curve.name) == (panel, name))
        values = next((curve.values for curve in curves), np.zeros(0))
        return values[np.isfinite(values)]

    @property
    def facts(self) -> list[Fact]:
        """The key numbers."""
        arrived, e_c = self.transmissions, self.values(ERRORS, "‖e_c‖ controller")
        name = next((curve.name for curve in self.curves if curve.panel == NORM), "")
        norm, norm_name = self.values(NORM, name), name.removesuffix(" plant")
        lost = int(np.sum(~arrived))
        share = f" ({100 * lost / len(arrived):.0f} %)" if len(arrived) else ""
        bursts = np.diff(np.flatnonzero(np.concatenate([[True], arrived, [True]]))) - 1
        facts = [
            Fact("transmissions", str(len(arrived))),
            Fact("lost", f"{lost}{share}"),
            Fact("longest loss burst", str(int(bursts.max(initial=0)))),
        ]
        if len(norm):
            facts += [
                Fact(f"{norm_name} at the start", _number(norm[0])),
                Fact(f"{norm_name} at the end", _number(norm[-1])),
            ]
        return [*facts, *([Fact("largest ‖e_c‖", _number(e_c.max()))] if len(e_c) else [])]


def panel_title(panel: str, curves: Sequence[noack.Curve]) -> str:
    """Return the title of a panel of a run with these curves: an output's is |y|, or |y − r|."""
    output = panel.removeprefix(_OUTPUT)
    target = " − r" if any(curve.name == "x_r reference" for curve in curves) else ""
    return panel if output == panel else f"|{output}{target}|"


@dataclass(frozen=True)
class Guarantee:
    """What is guaranteed for a scenario's own plant and schedule."""

    line: VerdictText
    curves: list[noack.Curve]
    """The bounds."""
    facts: list[Fact]


def run_of(scenario: noack.Scenario) -> ShownRun:
    """Run a scenario exactly if the exact simulation covers it, else in virtual time.

    Raises:
        NoackError: the scenario has several loops.
    """
    try:
        return exact_run_of(scenario)
    except noack.NoackError as error:
        if scenario.loops:
            raise CallerError("a scenario of several loops: run it live") from None
        note = f"in virtual time; an exact run is not possible: {str(error).removeprefix(_CONTINUOUS)}"
    run = noack.simulate(scenario)
    curves = [curve for curve in run.curves() if curve.style.colour != _GREEN]  # bounds come later
    return ShownRun(SIMULATED, curves, _lines(run), note)


def exact_run_of(scenario: noack.Scenario) -> ShownRun:
    """Run a scenario exactly, in some milliseconds.

    Raises:
        NoackError: the exact simulation does not cover the scenario.
    """
    run = noack.simulate_exactly(scenario, most_events=MOST_EVENTS)
    return ShownRun(EXACT, run.curves(), _lines(run))


def guarantee_of(scenario: noack.Scenario) -> Guarantee:
    """Return what is certified; that nothing is, is no error."""
    try:
        certificates = noack.certify(scenario, search=False)  # a search takes seconds
    except noack.NoackError as error:
        return Guarantee(VerdictText(f"no certificate: {error}", "doubt"), [], [])
    certificate, answer = certificates.schedule, certificates.answer
    proven = certificate.proven
    if proven is None:
        return Guarantee(VerdictText(answer.text, "doubt"), [], [])
    t_s = np.linspace(0.0, scenario.horizon_s, _POINTS)
    style = noack.CurveStyle(_GREEN, 1.6, _DASHED)
    with np.errstate(all="ignore"):
        bounds = [(ERRORS, certificate.controller_error(t_s)), (NORM, certificate.state(t_s))]
        of_outputs = certificates.output_bounds(certificate) if scenario.outputs else []
        bounds += [(of_each.output.distance, of_each.certificate.state(t_s)) for of_each in of_outputs]
    facts = [
        *(Fact(each.output.name, each.statement.removeprefix(f"{each.output.name} ")) for each in of_outputs),
        Fact("minimum inter-event time", f"{_number(1e3 * (certificate.inter_event_s or 0.0))} ms"),
        Fact("bound of ‖e_c‖", certificate.formula("‖e_c‖", "e_c")),
        Fact("bound of ‖x‖", certificate.formula("‖x‖", "x")),
    ]
    facts += [
        Fact(assumption.what, f"{assumption.verdict} ({assumption.why})")
        for assumption in certificate.assumptions
        if assumption.verdict != "holds"
    ]
    words = "all errors stay bounded"
    if proven.rate_per_s > 0:
        words = f"all errors decay at {_number(proven.rate_per_s)} /s"
        if any(bound.constant for bound in proven.bounds.values()):
            words += ", to a bound that does not decay"  # a floor, disturbances, noise
    line = VerdictText(f"{answer.text}: {words}, for every loss pattern that the guarantee allows", "good")
    curves = [noack.Curve(panel, "certified bound", "", t_s, values, style) for panel, values in bounds]
    return Guarantee(line, curves, facts)


def kept_line(run: ShownRun, guarantee: Guarantee) -> VerdictText:
    """Return the line of the certificate, with the largest share of its bound that ‖e_c‖ reached."""
    error = next((curve for curve in run.curves if curve.name == "‖e_c‖ controller"), None)
    bound = next((curve for curve in guarantee.curves if curve.panel == ERRORS), None)
    if error is None or bound is None or not np.isfinite(error.values).any():
        return guarantee.line
    with np.errstate(all="ignore"):
        limit = np.exp(np.interp(error.t_s, bound.t_s, np.log(bound.values)))
        share = float(np.nanmax(error.values / limit))
    if share > 1.0:
        return VerdictText(f"guarantee broken: ‖e_c‖ reached {_number(100 * share)} % of its bound", "bad")
    return VerdictText(
        f"{guarantee.line.text}; ‖e_c‖ was at most {_number(100 * share)} % of its bound", "good"
    )


def margin_of(scenario: noack.Scenario) -> str:
    """Return with how many losses in a row the loop is stable for every pattern; this may take minutes."""
    try:
        return str(noack.margin(scenario, accuracy=_MARGIN_ACCURACY, period=False).verdict)
    except noack.NoackError as error:
        return str(error)


def recorded_run(directory: Path, loop: str | None) -> ShownRun:
    """Return a loop of a recorded run, by default its first, with its certified bounds.

    Raises:
        NoackError: the run is still active, or its record is damaged.
    """
    run = noack.open_run(directory)
    loops = dict(run.loops)
    chosen = loops[loop] if loop in loops else next(iter(loops.values()))
    return ShownRun(RECORDED, chosen.curves(), _lines(run), loops=tuple(loops))


def replay(directory: Path) -> str:
    """Replay a run; return in words whether it is bit-exact."""
    result = noack.open_run(directory).replay()
    if result.bit_exact:
        return "replay: bit-exact, the same numbers again"
    return f"replay: differs: {result.first_difference}"


def report_page(directory: Path) -> bytes:
    """Return the report of a run."""
    return noack.open_run(directory).report().read_bytes()


def compare(reference: ShownRun, run: ShownRun) -> list[tuple[str, str, str]]:
    """Return the key numbers of both, a row each."""
    before = dict(reference.facts)
    return [(label, before.get(label, "–"), value) for label, value in run.facts]


def _lines(run: Any) -> list[VerdictText]:
    return [VerdictText(line.text, str(line.tone)) for line in run.verdict]


def _number(value: float) -> str:
    return f"{value:.3g}"
