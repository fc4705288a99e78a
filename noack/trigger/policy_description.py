"""What a policy does, as a person reads it."""

from noack.config.triggers import (
    Absolute,
    AnyTrigger,
    Deadline,
    Decaying,
    Dwell,
    Dynamic,
    Lyapunov,
    Mixed,
    Periodic,
    Quadratic,
    Relative,
    SelfTriggered,
)


def trigger_text(trigger: AnyTrigger) -> str:
    """Return when the sensor transmits, in one line."""
    match trigger:
        case Decaying():
            return f"‖e_s‖ > {_threshold(trigger)}"
        case Absolute():
            return f"‖e_s‖ > {trigger.delta:g}"
        case Relative():
            return f"‖e_s‖ > {trigger.sigma:g} ‖x‖"
        case Mixed():
            return f"‖e_s‖² > {trigger.sigma:g}² ‖x‖² + {trigger.epsilon:g}²"
        case Quadratic():
            beat = f", or {trigger.heartbeat} times later" if trigger.heartbeat else ""
            return f"zᵀQz > {trigger.epsilon:g}, looked at every {trigger.period_s:g} s{beat}"
        case Lyapunov():
            return f"V(x) > V(x(t_k)) e^(−{trigger.rate_per_s:g} (t−t_k))"
        case Dynamic():
            return (
                f"η + {trigger.theta_s:g} w ≤ 0, dη/dt = −{trigger.decay_per_s:g} η + w, "
                f"w = {trigger.sigma:g} xᵀQx − 2 xᵀPBK e_s"
            )
        case Periodic():
            return f"every {trigger.period_s:g} s"
        case SelfTriggered():
            return f"‖e_s‖ could reach {_threshold(trigger)}, by what is known at the last event"
        case Deadline():
            return f"{trigger_text(trigger.rule)}, or {trigger.interval_s:g} s after the last event"
        case Dwell():
            return (
                f"{trigger_text(trigger.rule)}, not within {trigger.interval_s:g} s of the last "
                "event"
            )


def _threshold(trigger: Decaying | SelfTriggered) -> str:
    faded = f"{trigger.beta:g} e^(−{trigger.alpha_per_s:g} t)"
    return f"max({faded}, {trigger.floor:g})" if trigger.floor else faded
