"""Settings with which a scenario has a certificate: each was tried as it is written, alone.

The candidates are few and fixed, and a limited number is tried, each without a search for the smallest
bounds. What is not found says nothing.
"""

import json
import math
from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

from cosim.analysis.scenario_certificates import quick_certificate
from cosim.analysis.witnesses import plants_of
from netem.core.clock import NS_PER_S
from netem.core.errors import NoackError
from netem.core.number_format import to_digits
from netem.core.settings_section import Table
from noack.scenario.overload import refuse_overload
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate
from noack.theory.certificates.conditions import certified_delay_s

_MOST_TRIALS = 24
"""Settings that are tried."""
_SHARES = (0.5, 0.2, 0.1, 0.05)
"""Smaller values that are tried, as shares of the present one."""
_DELAYS_S = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.0)
"""Delays of the network that are tried where the present one has no known bound."""
MOST_S = 10.0
"""No larger delays are tried."""
_NEARLY, _MOST_SHRINKS = 1.2, 8
"""Two values are nearly the same; no smaller share of the first value is tried."""
_FACTORS = (2, 5, 10)
"""Higher rates that are tried, as multiples of the present one."""
_RATES = ("plant.rate_hz", "controller.rate_hz")
_TRIGGER_KEYS = ("sigma", "period_s", "interval_s")
"""Keys of the trigger of which smaller values are tried."""
Values = Mapping[str, object]
"""Values of settings by their keys."""


class TriedSettings(NamedTuple):
    """Settings with which there is a certificate."""

    values: Values
    share: float | None = None
    """Of the present values, entry by entry, that these are; None if they are written themselves."""

    @property
    def text(self) -> str:
        """The settings as in a scenario file, and what the network must do for them."""
        if self.share is not None:
            return f"{' and '.join(self.values)} times {self.share:g}, entry by entry"
        text = " and ".join(f"{key} = {_written(value)}" for key, value in self.values.items())
        is_delay = "certificate.network_delay_s" in self.values
        return f"{text} (the network must then delay no update by more)" if is_delay else text


class SettingTrials:
    """Trials of settings of a resolved scenario, of which a limited number is certified.

    Args:
        resolved: the scenario, with its own plant.
    """

    def __init__(self, resolved: Scenario) -> None:
        self._scenario, self._content = resolved, dict(resolved.content())
        self.left = _MOST_TRIALS
        """How many may still be tried."""

    def first(self, candidates: Iterable[Values], *, plants: str | None = None) -> TriedSettings | None:
        """Return the first settings with a certificate for the scenario's schedule, None if there are none.

        ``plants``: "box" for all plants of the uncertainty box; by default the scenario's own.
        """
        for values in candidates:
            if self.left <= 0:
                break
            if self._is_certified(values, plants):
                return TriedSettings(values)
        return None

    def largest(self, key: str, present: float, first: float, most: float) -> TriedSettings | None:
        """Return nearly the largest value above the present one with a certificate; None if there is none.

        ``first`` is tried first, then twice and half of what was tried.
        """
        low, high, value = present, most, first
        while self.left > 0 and high > _NEARLY * low:
            value = to_digits(value, 2)
            if not low < value < high:
                break
            low, high = (value, high) if self._is_certified({key: value}) else (low, value)
            value = min(2 * low, math.sqrt(low * high)) if low > present else (present + high) / 2
            if low == present and high < first / _MOST_SHRINKS:
                break
        return TriedSettings({key: low}) if low > present else None

    def _is_certified(self, values: Values, plants: str | None = None) -> bool:
        """Return whether there is a certificate with some values; not if they are not legal."""
        try:
            changed = resolve(self._with(values))
        except (NoackError, ValueError):  # not a legal value, or a link that must overflow
            return False
        self.left -= 1
        own = plants or plants_of(changed)[0]
        return quick_certificate(changed, own).exists

    def _with(self, values: Values) -> Scenario:
        content = self._content
        for key, value in values.items():
            content = replaced(content, key.split("."), value)
        scenario = validate(content, self._scenario.name)
        refuse_overload(scenario)
        return scenario


def helpful_settings(resolved: Scenario) -> Iterator[TriedSettings]:
    """Yield settings, each of which alone gives a scenario's own linear plant a certificate.

    A higher rate may be one of both plant and controller. A plant by its equations has none without a
    search, which is too long for this.

    Args:
        resolved: the scenario, which has none.
    """
    trials = SettingTrials(resolved)
    for candidates in _candidates(resolved) if resolved.coverage.is_linear else ():
        if (tried := trials.first(candidates)) is not None:
            yield tried


def helpful_box(resolved: Scenario) -> TriedSettings | None:
    """Return smaller half-widths with which the uncertainty box has a certificate, None if none was found."""
    plant, trials = resolved.plant, SettingTrials(resolved)
    halfwidths = {"plant.uncertainty_A": plant.uncertainty_A, "plant.uncertainty_B": plant.uncertainty_B}
    for share in _SHARES:
        values = {
            key: [[share * entry for entry in row] for row in rows]
            for key, rows in halfwidths.items()
            if rows is not None
        }
        if trials.first([values], plants="box") is not None:
            return TriedSettings(values, share)
    return None


def largest_settings(resolved: Scenario) -> Iterator[TriedSettings]:
    """Yield the largest delay of the network and period of measurements that were tried, each alone.

    Args:
        resolved: the scenario, which has a certificate.
    """
    if not resolved.coverage.is_linear:
        return
    trials, present_s = SettingTrials(resolved), float(certified_delay_s(resolved))
    period_s = resolved.timing.measurement_period_ns / NS_PER_S
    if not resolved.network.link.queues or present_s:
        key, first_s = "certificate.network_delay_s", max(2 * present_s, period_s)
        if (tried := trials.largest(key, present_s, first_s, MOST_S)) is not None:
            yield tried
    if resolved.observer is None:  # an observer's gain is for its period
        every = resolved.plant.measure_every
        factors = (10, 5, 2)
        counts = ({"plant.measure_every": factor * every} for factor in factors)
        if (tried := trials.first(counts)) is not None:
            yield tried


def _candidates(resolved: Scenario) -> Iterator[Iterable[Values]]:
    """Yield, for each kind of settings, its values in the order in which they are tried."""
    network, trigger, plant = resolved.network, resolved.trigger, resolved.plant
    delay_s, is_known = float(certified_delay_s(resolved)), resolved.certificate.network_delay_s is not None
    if is_known or not network.link.queues:
        delays_s = [to_digits(share * delay_s) for share in _SHARES] if delay_s else []
    else:
        delays_s = [*_DELAYS_S]
    yield ({"certificate.network_delay_s": value} for value in delays_s)
    yield ({"network.mansd": most} for most in _smaller(network.mansd))
    if not plant.system.has_own_step and resolved.observer is None:  # an observer's gain is for its period
        rates = {key: getattr(resolved, key.partition(".")[0]).rate_hz for key in _RATES}
        sets = _RATES[:1], _RATES[1:], _RATES  # both only if neither alone is enough
        yield ({key: factor * rates[key] for key in keys} for keys in sets for factor in _FACTORS)
    for key in _TRIGGER_KEYS:
        if value := getattr(trigger, key, None):
            yield ({f"trigger.{key}": to_digits(share * value)} for share in _SHARES)


def _smaller(most: int) -> list[int]:
    """Return smaller numbers of losses: one less, and fractions down to 0."""
    return sorted({most - 1, 3 * most // 4, most // 2, most // 4, 1, 0} & {*range(most)}, reverse=True)


def replaced(content: Table, keys: list[str], value: object) -> Table:
    """Return a table with another value under nested keys."""
    key, *inner = keys
    table = content.get(key, {})
    return content | {key: replaced(table, inner, value) if inner and isinstance(table, dict) else value}


def _written(value: object) -> str:
    """Return a value as in a scenario file."""
    is_short = isinstance(value, float) and float(f"{value:g}") == value
    return f"{value:g}" if is_short else json.dumps(value)
