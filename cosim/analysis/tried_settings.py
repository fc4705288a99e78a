"""Settings with which a scenario has a certificate: each was tried as it is written, alone.

The candidates are few and fixed, and a limited number is tried. What is not found says nothing.
"""

import json
import math
from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

from noack.core.clock import NS_PER_S
from noack.core.errors import NoackError
from noack.core.number_format import to_digits
from noack.scenario.overload import refuse_overload
from noack.scenario.resolution import loop_of, resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate
from noack.settings.section import Table
from noack.theory.bounds.certificate_terms import NetworkConditions
from noack.theory.certificates.conditions import about_reference, certified_delay_s, nominal_conditions
from noack.theory.certificates.network_limits import MOST_S
from noack.theory.certificates.refusals import refusal_under
from noack.theory.certificates.region import scopes
from noack.theory.certificates.scenario_certificates import CertificateScope, box_scope

_MOST_TRIALS = 24
"""Settings that are tried for a linear plant."""
_TRIALS_BY_STATES = 40
"""Those for a plant on a region, times its number of states: each takes longer."""
_LEAST_TRIALS = 4
_SHARES = (0.5, 0.2, 0.1, 0.05)
"""Smaller values that are tried, as shares of the present one."""
_DELAYS_S = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.0)
"""Delays of the network that are tried where the present one has no known bound."""
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


class _ChangedScope(NamedTuple):
    """The plants and conditions of a scenario with other settings."""

    scope: CertificateScope
    conditions: NetworkConditions

    @property
    def has_loop_gain(self) -> bool:
        """Whether the loop gain is below 1: it says so without the tightest bounds."""
        return self.scope.loop_gain(self.conditions) < 1

    @property
    def is_certified(self) -> bool:
        """Whether there is a certificate."""
        return self.scope.certificate(self.conditions).exists


class SettingTrials:
    """Trials of settings of a resolved scenario, of which a limited number is certified.

    Args:
        resolved: the scenario, with its own plant.
        late_periods: allowed lateness in steps of the plant.
    """

    def __init__(self, resolved: Scenario, late_periods: int) -> None:
        self._scenario, self._late_periods = resolved, late_periods
        self._content: Table = dict(resolved.content())
        is_linear, n = resolved.coverage.is_linear, loop_of(resolved).n
        self.left = _MOST_TRIALS if is_linear else max(_TRIALS_BY_STATES // n, _LEAST_TRIALS)
        """How many may still be tried."""

    def first(self, candidates: Iterable[Values], *, box: bool = False) -> TriedSettings | None:
        """Return the first settings with a certificate for the scenario's schedule, None if there are none.

        ``box``: of all plants of the uncertainty box; else of the scenario's own.
        """
        for values in candidates:
            if self.left <= 0:
                break
            trial = self._trial(values, box=box)
            if trial is not None and trial.has_loop_gain and trial.is_certified:
                return TriedSettings(values)
        return None

    def largest(self, key: str, low: float, high: float) -> TriedSettings | None:
        """Return nearly the largest value with a certificate, of those with three digits above ``low``.

        None if there is none. ``low`` has a certificate, and ``high`` has perhaps none.
        """
        step = 10.0 ** (math.floor(math.log10(high)) - 2)
        found = list[tuple[float, _ChangedScope]]()
        while high - low > 1.5 * step and self.left > 0:
            value = to_digits((low + high) / 2)
            trial = self._trial({key: value})
            if trial is not None and trial.has_loop_gain:
                found.append((value, trial))
                low = value
            else:
                high = value
        largest = (value for value, trial in reversed(found[-2:]) if trial.is_certified)
        return next((TriedSettings({key: value}) for value in largest), None)

    def _trial(self, values: Values, *, box: bool = False) -> "_ChangedScope | None":
        """Return what is tried with some values; None if they are not legal, or cannot have a certificate."""
        try:
            changed = resolve(self._with(values))
            if changed.coverage.is_linear:
                changed = about_reference(changed, self._late_periods)
            scope = box_scope(changed) if box else next(iter(scopes(changed)), None)
        except (NoackError, ValueError):  # not a legal value, or a link that must overflow
            return None
        conditions = nominal_conditions(changed, self._late_periods)
        if scope is None or refusal_under(conditions, changed, scope.name) is not None:
            return None
        self.left -= 1
        return _ChangedScope(scope, conditions)

    def _with(self, values: Values) -> Scenario:
        content = self._content
        for key, value in values.items():
            content = replaced(content, key.split("."), value)
        scenario = validate(content, self._scenario.name)
        refuse_overload(scenario)
        return scenario


def helpful_settings(resolved: Scenario, late_periods: int) -> Iterator[TriedSettings]:
    """Yield settings, each of which alone gives a scenario's own plant a certificate.

    A higher rate may be one of both plant and controller.

    Args:
        resolved: the scenario, which has none.
        late_periods: allowed lateness in steps of the plant.
    """
    trials = SettingTrials(resolved, late_periods)
    for candidates in _candidates(resolved):
        if (tried := trials.first(candidates)) is not None:
            yield tried


def helpful_box(resolved: Scenario, late_periods: int) -> TriedSettings | None:
    """Return smaller half-widths with which the uncertainty box has a certificate, None if none was found."""
    plant, trials = resolved.plant, SettingTrials(resolved, late_periods)
    halfwidths = {"plant.uncertainty_A": plant.uncertainty_A, "plant.uncertainty_B": plant.uncertainty_B}
    for share in _SHARES:
        values = {
            key: [[share * entry for entry in row] for row in rows]
            for key, rows in halfwidths.items()
            if rows is not None
        }
        if trials.first([values], box=True) is not None:
            return TriedSettings(values, share)
    return None


def largest_settings(
    resolved: Scenario, late_periods: int, delay_s: float, sampling_s: float | None
) -> Iterator[TriedSettings]:
    """Yield the largest delay of the network and period of measurements that were tried, each alone.

    Args:
        resolved: the scenario, which has a certificate.
        late_periods: allowed lateness in steps of the plant.
        delay_s: the largest certified delay of updates, with all waits; ``MOST_S`` is any.
        sampling_s: the largest certified sampling period, as well; None: another one needs another observer.
    """
    trials, present_s = SettingTrials(resolved, late_periods), float(certified_delay_s(resolved))
    if present_s < delay_s < MOST_S and (
        tried := trials.largest("certificate.network_delay_s", present_s, delay_s)
    ):
        yield tried
    longest_s = 0.0 if sampling_s is None or sampling_s >= MOST_S else sampling_s
    most = math.floor(longest_s * NS_PER_S / resolved.timing.plant_period_ns)
    fewer = range(most, max(most - 4, resolved.plant.measure_every), -1)
    if (tried := trials.first({"plant.measure_every": count} for count in fewer)) is not None:
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
    is_on_region = not resolved.coverage.is_linear
    for key in (*_TRIGGER_KEYS, *(["beta"] if is_on_region else [])):
        if value := getattr(trigger, key, None):
            yield ({f"trigger.{key}": to_digits(share * value)} for share in _SHARES)
    if is_on_region:
        yield (
            {"plant.initial_state": [to_digits(share * entry) for entry in plant.initial_state]}
            for share in _SHARES
        )


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
