"""The observer section of a scenario: one of the kinds in :mod:`noack.observers`."""

from typing import TYPE_CHECKING

from noack.observers.observer_settings import ObserverSettings
from noack.settings.registry import kinds_in, union_of

OBSERVERS = kinds_in("noack.observers", ObserverSettings)
"""Settings classes by kind."""

if TYPE_CHECKING:
    AnyObserver = ObserverSettings
else:
    AnyObserver = union_of(OBSERVERS)
