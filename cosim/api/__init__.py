"""The library: the names that ``import noack`` offers to programs and notebooks.

``docs/library.md`` documents it. The import loads neither viewer nor control plane nor plots. Each
function imports these modules when it is first called.
"""

from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from typing import TYPE_CHECKING

from cosim.analysis.certificates import Certificates as Certificates
from cosim.api.exact_runs import ExactRun as ExactRun
from cosim.api.exact_runs import simulate_exactly as simulate_exactly
from cosim.api.explorer import Explorer as Explorer
from cosim.api.explorer import explore as explore
from cosim.api.runs import Run as Run
from cosim.api.runs import compare as compare
from cosim.api.runs import open_run as open_run
from cosim.api.runs import run as run
from cosim.api.runs import simulate as simulate
from cosim.api.scenarios import from_system as from_system
from cosim.api.scenarios import load as load
from cosim.api.scenarios import scenarios as scenarios
from cosim.api.scenarios import with_settings as with_settings
from cosim.api.studies import CampaignResult as CampaignResult
from cosim.api.studies import Measurement as Measurement
from cosim.api.studies import campaign as campaign
from cosim.api.studies import certify as certify
from cosim.api.studies import cost as cost
from cosim.api.studies import margin as margin
from cosim.api.studies import measure as measure
from cosim.api.studies import save_tables as save_tables
from cosim.output.curves import Curve as Curve
from cosim.output.curves import CurveStyle as CurveStyle
from cosim.studies.new_loop.linear_model import gain as gain
from cosim.studies.new_loop.linear_model import linearise as linearise
from cosim.studies.new_loop.new_scenario import new as new
from noack.core.core_library import require_live_runs
from noack.core.errors import CallerError as _CallerError
from noack.core.errors import NoackError as NoackError
from noack.scenario.scenario import Scenario as Scenario

if TYPE_CHECKING:  # the one needs an extra, the other needs Linux
    from cosim.api.lossy_channel import LossyChannel as LossyChannel
    from netem.lossy_udp import LossyUdp as LossyUdp

__version__ = version("noack")

# `help(noack.simulate)` names the module that programs import.
for _public in list(globals().values()):
    if getattr(_public, "__module__", "").startswith("cosim."):
        _public.__module__ = "noack"


def __getattr__(name: str) -> object:
    """Return one of the names that not every machine has (PEP 562)."""
    if name == "LossyUdp":
        require_live_runs()
        module = "netem.lossy_udp"
    elif name == "LossyChannel":
        if find_spec("gymnasium") is None:
            raise _CallerError(
                "noack.LossyChannel needs a package that is not installed; pip install 'noack[gymnasium]'"
            )
        module = "cosim.api.lossy_channel"
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    member: object = getattr(import_module(module), name)
    return member
