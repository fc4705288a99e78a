"""Every trigger policy: the settings classes that the files of this folder define.

Everything that needs a list of the policies takes it from here: the scenario's table ``trigger``,
its JSON Schema, the tests of the documentation, property tests and benchmarks.
"""

from functools import reduce
from importlib import import_module
from operator import or_
from pkgutil import iter_modules
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Discriminator, Tag

import noack.trigger
from noack.trigger.policy_settings import PolicySettings

_DEFAULT = "decaying"
"""The policy of a table without the key ``policy``: the paper's."""


def _policies() -> dict[str, type[PolicySettings]]:
    """The settings of each policy by the policy's name, the default first."""
    found = {}
    for module in iter_modules(noack.trigger.__path__, f"{noack.trigger.__name__}."):
        if module.name == __name__:
            continue
        for value in vars(import_module(module.name)).values():
            own = isinstance(value, type) and value.__module__ == module.name
            if own and issubclass(value, PolicySettings) and "policy" in value.model_fields:
                (name,) = value.model_fields["policy"].annotation.__args__
                found[name] = value
    return dict(sorted(found.items(), key=lambda item: (item[0] != _DEFAULT, item[0])))


def _name(given: object) -> object:
    """The policy that a table names."""
    if isinstance(given, dict):
        return given.get("policy", _DEFAULT)
    return getattr(given, "policy", None)


POLICIES = _policies()

if TYPE_CHECKING:
    AnyTrigger = PolicySettings
else:
    _tagged: Any = (Annotated[settings, Tag(name)] for name, settings in POLICIES.items())
    AnyTrigger = Annotated[reduce(or_, _tagged), Discriminator(_name)]
    for _settings in POLICIES.values():  # a policy may combine others
        _settings.model_rebuild(_types_namespace={"AnyTrigger": AnyTrigger})
