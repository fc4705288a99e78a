"""What a controller may do between two updates, and how a scenario says so."""

from dataclasses import dataclass
from typing import Literal

from noack.core.clock import NEVER_NS, NS_PER_S
from noack.core.errors import CallerError
from noack.scenario.scenario import Scenario
from noack.theory.margins.time_triggered_loop import LoopTimes

_LENGTHS = (2, 4, 8)
"""Numbers of predictions that are tried, if none is given."""
_MOST = 64
"""Largest number of predictions."""


@dataclass(frozen=True)
class Hold:
    """A hold strategy; two that are equal do the same."""

    text: str
    mode: Literal["model", "zoh"]
    periods: int = 0
    """Number of periods for which the newest update is used; 0: forever, or the scenario's timeout."""
    timeout_input: Literal["safe", "hold"] = "safe"
    timeout_s: float | None = None
    """The timeout of the given scenario."""

    def timeout_ns(self, times: LoopTimes) -> int:
        """Return the age from which on an update is not used, for periodic updates.

        A late update still replaces the one before: a period of the controller is added, or less.
        """
        if self.periods == 0:
            return NEVER_NS if self.timeout_s is None else round(self.timeout_s * NS_PER_S)
        late_ns = min(times.tick_ns, (times.period_ns - times.delay_ns) // 2)
        return self.periods * times.period_ns + times.delay_ns + late_ns

    def changes(self, scenario: Scenario, times: LoopTimes) -> dict[str, object]:
        """Return the keys of a scenario that say so."""
        if (timeout_ns := self.timeout_ns(times)) == NEVER_NS:
            keys: dict[str, object] = {"update_timeout_s": None, "timeout_input": "safe"}
        else:
            keys = {"update_timeout_s": timeout_ns / NS_PER_S, "timeout_input": self.timeout_input}
            keys |= {"safe_input": None} if self.periods else {}
        return {"mode": self.mode, "controller": scenario.controller.model_copy(update=keys)}


def _predictions(number: int, timeout_input: Literal["safe", "hold"] = "safe") -> Hold:
    after = "zero" if timeout_input == "safe" else "hold"
    return Hold(f"{number} predictions, then {after}", "model", number, timeout_input)


HOLDS = {
    "zero": (Hold("zero", "zoh", 1),),
    "zoh": (Hold("hold", "zoh"),),
    "model": (Hold("the model's input", "model"),),
    "predictions": tuple(map(_predictions, _LENGTHS)),
}
"""By their words on the command line."""


def given_hold(scenario: Scenario) -> Hold:
    """Return the strategy of a scenario."""
    controller = scenario.controller
    if controller.update_timeout_s is None:
        return HOLDS[scenario.mode][0]
    text, timeout_s = scenario.between_updates, controller.update_timeout_s
    return Hold(text, scenario.mode, 0, controller.timeout_input, timeout_s)


def read_holds(words: str) -> list[Hold]:
    """Return the strategies of some words, separated by commas.

    ``predictions:N`` has N predictions and then the input 0, ``predictions:N:hold`` the last one.

    Raises:
        CallerError: a word has no strategy.
    """
    holds: list[Hold] = []
    for word in map(str.strip, words.split(",")):
        match word.split(":"):
            case [name] if name in HOLDS:
                holds += HOLDS[name]
            case ["predictions", number] if number.isdecimal() and 1 <= int(number) <= _MOST:
                holds.append(_predictions(int(number)))
            case ["predictions", number, "hold"] if number.isdecimal() and 1 <= int(number) <= _MOST:
                holds.append(_predictions(int(number), "hold"))
            case _:
                names = ", ".join(HOLDS)
                raise CallerError(
                    f"--holds: {names}, predictions:N or predictions:N:hold (N from 1 to {_MOST}), "
                    f'not "{word}"'
                )
    return list(dict.fromkeys(holds))
