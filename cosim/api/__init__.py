"""The library: the names that ``import noack`` offers to programs and notebooks.

``docs/library.md`` documents it. What takes long to import is looked up when it is first used.
"""

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING

from cosim.analysis.certificates import Certificates as Certificates
from cosim.api.analyses import certify as certify
from cosim.api.analyses import cost as cost
from cosim.api.analyses import margin as margin
from cosim.api.exact_runs import ExactRun as ExactRun
from cosim.api.exact_runs import simulate_exactly as simulate_exactly
from cosim.api.runs import Run as Run
from cosim.api.runs import compare as compare
from cosim.api.runs import open_run as open_run
from cosim.api.runs import run as run
from cosim.api.runs import simulate as simulate
from cosim.api.scenarios import from_system as from_system
from cosim.api.scenarios import load as load
from cosim.api.scenarios import scenarios as scenarios
from cosim.api.scenarios import with_settings as with_settings
from cosim.api.virtual_network import VirtualNetwork as VirtualNetwork
from cosim.live.monitoring.run_observers import RunObserver as RunObserver
from cosim.output.curves import Curve as Curve
from cosim.output.curves import CurveStyle as CurveStyle
from cosim.studies.new_loop.linear_model import gain as gain
from cosim.studies.new_loop.linear_model import linearise as linearise
from cosim.studies.new_loop.new_scenario import new as new
from noack.core.core_library import require_live_runs
from noack.core.errors import NoackError as NoackError
from noack.scenario.scenario import Scenario as Scenario

if TYPE_CHECKING:
    from cosim.api.campaigns import CampaignResult as CampaignResult
    from cosim.api.campaigns import campaign as campaign
    from cosim.api.measurements import Measurement as Measurement
    from cosim.api.measurements import measure as measure
    from cosim.api.tables import save_tables as save_tables
    from cosim.live.followed_run import follow as follow
    from cosim.output.export.export_formats import ExportedRun as ExportedRun
    from netem.lossy_udp import LossyUdp as LossyUdp

_LATER = {
    "CampaignResult": "cosim.api.campaigns",
    "campaign": "cosim.api.campaigns",
    "Measurement": "cosim.api.measurements",
    "measure": "cosim.api.measurements",
    "save_tables": "cosim.api.tables",
    "ExportedRun": "cosim.output.export.export_formats",
    "LossyUdp": "netem.lossy_udp",
    "follow": "cosim.live.followed_run",
}
"""Names whose modules import scipy's statistics, matplotlib or zenoh, or need Linux."""

__version__ = version("noack")


def __getattr__(name: str) -> object:
    """Import one of the names that are looked up later (PEP 562)."""
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name in ("LossyUdp", "follow"):
        require_live_runs()
    return _public(getattr(import_module(_LATER[name]), name))


def _public(member: object) -> object:
    """Let ``help(noack.simulate)`` name the module that programs import."""
    if getattr(member, "__module__", "").startswith("cosim."):
        member.__module__ = "noack"
    return member


for _member in list(globals().values()):
    _public(_member)
