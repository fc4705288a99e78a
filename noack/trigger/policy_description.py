"""What a policy does, as a person reads it."""

from noack.config.triggers import (
    AbsoluteSettings,
    AnyTrigger,
    DeadlineSettings,
    DecayingSettings,
    DwellSettings,
    DynamicSettings,
    LyapunovSettings,
    MixedSettings,
    PeriodicSettings,
    QuadraticSettings,
    RelativeSettings,
    SelfTriggeredSettings,
)


def trigger_text(trigger: AnyTrigger) -> str:
    """Return when the sensor transmits, in one line."""
    match trigger:
        case DecayingSettings():
            return f"‖e_s‖ > {_threshold(trigger)}"
        case AbsoluteSettings():
            return f"‖e_s‖ > {trigger.delta:g}"
        case RelativeSettings():
            return f"‖e_s‖ > {trigger.sigma:g} ‖x‖"
        case MixedSettings():
            return f"‖e_s‖² > {trigger.sigma:g}² ‖x‖² + {trigger.epsilon:g}²"
        case QuadraticSettings():
            beat = f", or {trigger.heartbeat} times later" if trigger.heartbeat else ""
            return f"zᵀQz > {trigger.epsilon:g}, looked at every {trigger.period_s:g} s{beat}"
        case LyapunovSettings():
            return f"V(x) > V(x(t_k)) e^(−{trigger.rate_per_s:g} (t−t_k))"
        case DynamicSettings():
            return (
                f"η + {trigger.theta_s:g} w ≤ 0, dη/dt = −{trigger.decay_per_s:g} η + w, "
                f"w = {trigger.sigma:g} xᵀQx − 2 xᵀPBK e_s"
            )
        case PeriodicSettings():
            return f"every {trigger.period_s:g} s"
        case SelfTriggeredSettings():
            return f"‖e_s‖ could reach {_threshold(trigger)}, by what is known at the last event"
        case DeadlineSettings():
            return f"{trigger_text(trigger.rule)}, or {trigger.interval_s:g} s after the last event"
        case DwellSettings():
            return (
                f"{trigger_text(trigger.rule)}, not within {trigger.interval_s:g} s of the last "
                "event"
            )


def _threshold(trigger: DecayingSettings | SelfTriggeredSettings) -> str:
    faded = f"{trigger.beta:g} e^(−{trigger.alpha_per_s:g} t)"
    return f"max({faded}, {trigger.floor:g})" if trigger.floor else faded
