"""The trigger section of a scenario: one of the policies in :mod:`noack.trigger`."""

from typing import TYPE_CHECKING

from noack.settings.registry import kinds_in, union_of
from noack.trigger.policy_settings import PolicySettings

POLICIES = kinds_in("noack.trigger", PolicySettings, "policy")
"""Settings classes by policy."""

if TYPE_CHECKING:
    AnyTrigger = PolicySettings
else:
    AnyTrigger = union_of(POLICIES, "policy", default="decaying")
    for _settings in POLICIES.values():  # a policy may combine others
        _settings.model_rebuild(_types_namespace={"AnyTrigger": AnyTrigger})
