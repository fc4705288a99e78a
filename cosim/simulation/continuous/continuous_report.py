"""The run of ``noack simulate --trigger continuous``: its summary and its JSON document."""

from typing import Any

import numpy as np

from cosim.record.run_events import Divergence, divergence
from cosim.simulation.continuous.continuous_loop import Samples, continuous_loop_of
from cosim.simulation.continuous.continuous_run import (
    MAX_EVENTS,
    ContinuousRun,
    simulate_continuous,
)
from cosim.simulation.continuous.network_fates import network_fates
from noack.config.scenario import Scenario
from noack.core.errors import ExitStatus
from noack.core.linear_systems import Vector
from noack.trigger.decaying import DecayingTrigger

POINTS = 501
"""Number of evenly spaced times at which the document lists the states."""


def run_continuous(resolved: Scenario, max_events: int = MAX_EVENTS) -> ContinuousRun:
    """Run a resolved scenario in exact continuous time, with the losses of its own network.

    Raises:
        TooManyEventsError: more than ``max_events`` events, or two at the same time.
        CallerError: the threshold becomes too small to compute with.
    """
    return simulate_continuous(
        continuous_loop_of(resolved),
        horizon_s=resolved.horizon_s,
        delivered=network_fates(resolved),
        known_start=resolved.network.initial_sync == "known_state",
        max_events=max_events,
    )


@np.errstate(all="ignore")  # a run may diverge
def document(run: ContinuousRun, resolved: Scenario) -> dict[str, Any]:
    """Return the run as JSON: its summary, every event, and the states at 501 times."""
    samples = run.at(np.linspace(0.0, run.reached_s, POINTS))
    before = run.before
    return {
        "summary": summary(run, resolved),
        "events": [
            {
                "t_s": state.t_s,
                "delivered": bool(delivered),
                "x": state.x.tolist(),
                "e_s": state.e_s.tolist(),
                "e_c": state.e_c.tolist(),
            }
            for state, delivered in zip(before, run.delivered, strict=True)
        ],
        "state_names": list(run.system.loop.state_names),
        "samples": {
            "t_s": samples.t_s.tolist(),
            "x": samples.x.tolist(),
            "x_s": samples.x_s.tolist(),
            "x_c": samples.x_c.tolist(),
            "e_s_norm": run.e_s_norm(samples).tolist(),
            "e_c_norm": run.e_c_norm(samples).tolist(),
            "threshold": _thresholds(run, samples),
        },
    }


def _thresholds(run: ContinuousRun, samples: Samples) -> list[float] | None:
    if not isinstance(run.system.trigger, DecayingTrigger):
        return None
    return [run.system.threshold(t_s) for t_s in samples.t_s.tolist()]


def summary(run: ContinuousRun, resolved: Scenario) -> dict[str, Any]:
    """Return the run's numbers, with the keys of ``summary.json``."""
    samples = run.at(np.linspace(0.0, run.reached_s, POINTS))
    diverged = _divergence(run, samples, resolved)
    arrived = np.flatnonzero(run.delivered)
    drop_runs = np.diff(arrived, prepend=-1, append=len(run.delivered)) - 1
    return {
        "kind": "continuous",
        "scenario": resolved.name,
        "mode": resolved.mode,
        "mansd": resolved.network.mansd,
        "horizon_s": resolved.horizon_s,
        "reached_s": run.reached_s,
        "events": len(run.delivered),
        "deliveries": int(run.delivered.sum()),
        "drops": int((~run.delivered).sum()),
        "longest_loss_burst": int(drop_runs.max()),
        "inter_event_min_s": _or_none(np.min, np.diff(run.event_s)),
        "inter_event_median_s": _or_none(np.median, np.diff(run.event_s)),
        "inter_delivery_median_s": _or_none(np.median, np.diff(run.event_s[run.delivered])),
        "initial_state_norm": float(np.linalg.norm(samples.x[0])),
        "final_state_norm": float(np.linalg.norm(samples.x[-1])),
        "diverged_at_s": None if diverged is None else diverged.at_s,
        "exit": {
            "status": int(ExitStatus.OK if diverged is None else ExitStatus.FAILED),
            "reason": "horizon" if diverged is None else diverged.text,
        },
    }


def _divergence(run: ContinuousRun, samples: Samples, resolved: Scenario) -> Divergence | None:
    if run.diverged_at_s is not None:
        return Divergence(run.diverged_at_s, f"diverged at {run.diverged_at_s:g} s")
    return divergence([(samples.t_s, samples.x)], len(samples.t_s), [resolved])


def _or_none(statistic: Any, values: Vector) -> float | None:
    return float(statistic(values)) if len(values) else None
