"""Its import imports all that the processes of a run need, once, before they are forked."""

import gc
import os
from importlib import import_module

from netem.core.system_processes import QUICK_IMPORTS

_MODULES = (
    "plant_server.__main__",
    "sensor_node.__main__",
    "controller_node.__main__",
    "noack.network_process.__main__",
    "cosim.live.recording.recorder",
    "noack.scenario.scenario_file",
    "numpy.random",
)


def _preload() -> None:
    os.environ.update(QUICK_IMPORTS)
    gc.disable()
    for module in _MODULES:
        import_module(module)
    _build_validators()
    # What was collected now would leave holes, which each process would fill on pages of its own.
    gc.freeze()
    gc.enable()


def _build_validators() -> None:
    """Build what would otherwise be built in each process."""
    from pydantic import BaseModel

    from netem.impairments.kinds.loss import LossOf
    from netem.impairments.link_settings import LinkSettings
    from noack.runtime.control_messages import ControlMessage
    from noack.runtime.run_descriptor import RunDescriptor
    from noack.scenario.scenario import Scenario
    from noack.scenario.scenario_checks import prepare_changes

    models: list[type[BaseModel]] = [Scenario, RunDescriptor, LinkSettings, LossOf]
    for model in (*models, *ControlMessage.__subclasses__()):
        model.model_rebuild()
    prepare_changes()


_preload()
