"""The report of a run: its summary and its figures, as one HTML page."""

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from cosim.output.remarks import remarks
from cosim.output.report.report_findings import findings
from cosim.output.run_tables import interval_of, key_numbers
from noack.config.scenario import Scenario
from noack.core.number_format import whole

_NONE = "–"
_TONES = {
    "held": "good", "holds": "good",
    "violated": "bad",
    "void": "doubt",
}  # fmt: skip
_QUANTILES = {"p50": "p50", "p99": "p99", "p999": "p99.9", "max": "max"}


class Embedded(NamedTuple):
    """A figure of the page."""

    name: str
    markup: Markup
    caption: str


def page(
    scenario: Scenario,
    summary: Mapping[str, Any],
    figures: Sequence[Embedded],
    scenario_toml: str,
    environment: Mapping[str, Any],
) -> str:
    """Return the report of a run as HTML; everything but figures is escaped.

    Args:
        scenario: the resolved scenario.
        summary: the content of ``summary.json``.
        figures: the run's figures, in order.
        scenario_toml: the resolved scenario, as stored in the run directory.
        environment: the content of ``environment.json``; empty if there is none.
    """
    claims = _objects(summary.get("claims"))
    remarks_shown = list(_remarks(summary, claims))
    status = summary["exit"]["status"]
    kind = "simulated run" if summary.get("kind") == "simulated" else "live run"
    hold = "model-based" if scenario.mode == "model" else "zero-order hold"
    return templates().get_template("report.html.jinja").render(
        title=scenario.name,
        subtitle=", ".join(
            filter(None, (kind, hold, f"M − 1 = {scenario.network.mansd}", _started(environment)))
        ),
        description=scenario.description,
        ending=_ending(summary),
        verdict_tone="bad" if status else "doubt" if remarks_shown else "good",
        remarks=remarks_shown,
        # These have their own sections.
        key_numbers=key_numbers({**summary, "fidelity": None, "replay": None}),
        parameters=list(_parameters(scenario)),
        figures=figures,
        claims=[_claim(claim) for claim in claims],
        assumptions=_objects(summary.get("assumptions")),
        timing=list(_timing(summary)),
        timing_headings=[*_QUANTILES.values(), "count", "deadlines missed"],
        findings=list(findings(summary)),
        scenario_toml=scenario_toml,
        environment=[(_words(key), _line(value)) for key, value in environment.items()],
    )  # fmt: skip


@cache
def templates(folder: Path = Path(__file__).parent) -> Environment:
    """Return the templates of the report and of a folder; all text is escaped."""
    found = Environment(
        loader=FileSystemLoader([folder, Path(__file__).parent]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    found.filters["tone"] = lambda word: _TONES.get(word, "")
    return found


def _ending(summary: Mapping[str, Any]) -> str:
    end = summary["exit"]
    if not end["status"]:
        return f"The run completed its {_shown(summary['horizon_s'])} s."
    return (
        f"The run failed (exit status {end['status']}): {end['reason']}. "
        f"It reached {_shown(summary['reached_s'])} of {_shown(summary['horizon_s'])} s."
    )


def _remarks(summary: Mapping[str, Any], claims: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield the remarks that limit the validity of the rest."""
    yield from (remark.text for remark in remarks(dict(summary)))
    for verdict in ("violated", "void"):
        count = sum(claim.get("verdict") == verdict for claim in claims)
        if count:
            yield f"{count} of {len(claims)} claims are {verdict}: see Claims"


def _parameters(scenario: Scenario) -> Iterator[tuple[str, str]]:
    trigger, network = scenario.trigger, scenario.network
    every = scenario.plant.measure_every
    loss = network.loss.model_dump()
    model = loss.pop("model").replace("_", "-")
    details = ", ".join(f"{_words(key)} {_shown(value)}" for key, value in loss.items())
    yield "between updates", "model Â + B̂K" if scenario.mode == "model" else "zero-order hold"
    yield "trigger", trigger.description
    yield "norm of errors", "‖e‖₂" if trigger.weight is None else "‖W e‖₂, W from the scenario"
    yield "M − 1", f"{network.mansd}" + ("" if network.enforce_mansd else ", not enforced")
    yield "loss", f"{model} ({details})" if details else model
    if scenario.protocol.acknowledges:
        timeout_ms = 1e-6 * scenario.timing.acknowledgement_timeout_ns
        reverse = network.reverse.loss.model_dump()
        lost = ", ".join(f"{_words(key)} {_shown(value)}" for key, value in reverse.items())
        yield "acknowledgements", f"loss: {lost}; timeout {timeout_ms:g} ms"
    yield "initial synchronisation", network.initial_sync.replace("_", " ")
    yield "plant", f"{scenario.plant.rate_hz:g} steps/s"
    yield "measurements", "every step" if every == 1 else f"every {every} steps"
    yield (
        "controller",
        f"{scenario.controller.rate_hz:g} ticks/s, phase {scenario.controller.phase:g}",
    )
    yield "horizon", f"{scenario.horizon_s:g} s at speed {scenario.speed:g}"
    x0 = np.array(scenario.plant.initial_state)
    yield "‖x(0)‖", f"{np.linalg.norm(x0):.4g}, {len(x0)} states"
    seeds = scenario.seeds
    yield "seeds", f"plant {seeds.plant}, initial state {seeds.initial_state}, loss {seeds.loss}"


def _claim(claim: Mapping[str, Any]) -> dict[str, str]:
    texts = {key: _text(claim, key) for key in ("what", "source", "bound", "verdict", "why")}
    numbers = {key: _shown(claim.get(key)) for key in ("certified", "observed")}
    ratio = claim.get("ratio")
    numbers["ratio"] = f"{100 * ratio:.3g} %" if isinstance(ratio, float) else _shown(ratio)
    since_s = claim.get("since_s")
    since = "" if since_s is None else f"t = {_shown(since_s)} s"
    return texts | numbers | {"since": since, "interval": interval_of(dict(claim))}


def _text(mapping: Mapping[str, Any], key: str) -> str:
    value = mapping.get(key)
    return "" if value is None else str(value)


def _timing(summary: Mapping[str, Any]) -> Iterator[tuple[str, list[str]]]:
    if summary.get("kind") == "simulated":
        return
    for role, late in (summary.get("lateness_us") or {}).items():
        counts = [str(late["steps"]), str(late["late_steps"])]
        yield f"{role} lateness", [*(whole(late[key]) for key in _QUANTILES), *counts]
    latency = summary.get("latency_us")
    if latency:
        quantiles = [whole(latency[key]) for key in _QUANTILES]
        yield "sensor-to-controller latency", [*quantiles, str(latency["updates"]), ""]


def _started(environment: Mapping[str, Any]) -> str:
    started = environment.get("started")
    return f"started {started}" if started else ""


def _objects(value: Any) -> list[dict[str, Any]]:
    return [entry for entry in value if isinstance(entry, dict)] if isinstance(value, list) else []


def _words(key: str) -> str:
    return str(key).replace("_", " ")


def _line(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else _shown(value)


def _shown(value: Any) -> str:
    """Write a value of a JSON document as text."""
    if value is None:
        return _NONE
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, dict):
        return ", ".join(f"{_words(key)} {_shown(entry)}" for key, entry in value.items())
    return str(value)
