"""What every process agrees on: scenario, wire format, linear systems, records, clock.

To a program or a notebook, ``import noack`` is the laboratory, too: scenarios, runs, certificates
(``docs/library.md``). Those names are in modules above this package, mostly in :mod:`cosim.api`, and
are looked up when they are first used: a process that imports a module from here loads nothing else.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cosim.analysis.certificates import Certificates as Certificates
    from cosim.api.analyses import certify as certify
    from cosim.api.analyses import cost as cost
    from cosim.api.analyses import margin as margin
    from cosim.api.campaigns import CampaignResult as CampaignResult
    from cosim.api.campaigns import campaign as campaign
    from cosim.api.exact_runs import ExactRun as ExactRun
    from cosim.api.exact_runs import simulate_exactly as simulate_exactly
    from cosim.api.measurements import Measurement as Measurement
    from cosim.api.measurements import measure as measure
    from cosim.api.runs import Run as Run
    from cosim.api.runs import compare as compare
    from cosim.api.runs import open_run as open_run
    from cosim.api.runs import run as run
    from cosim.api.runs import simulate as simulate
    from cosim.api.scenarios import from_system as from_system
    from cosim.api.scenarios import load as load
    from cosim.api.scenarios import scenarios as scenarios
    from cosim.api.scenarios import with_settings as with_settings
    from cosim.api.tables import save_tables as save_tables
    from cosim.api.virtual_network import VirtualNetwork as VirtualNetwork
    from cosim.live.followed_run import follow as follow
    from cosim.live.monitoring.run_observers import RunObserver as RunObserver
    from cosim.output.curves import Curve as Curve
    from cosim.output.curves import CurveStyle as CurveStyle
    from cosim.output.export.export_formats import ExportedRun as ExportedRun
    from cosim.studies.new_loop.linear_model import gain as gain
    from cosim.studies.new_loop.linear_model import linearise as linearise
    from cosim.studies.new_loop.new_scenario import new as new
    from netem.core.errors import NoackError as NoackError
    from netem.lossy_udp import LossyUdp as LossyUdp
    from noack.scenario.scenario import Scenario as Scenario

    __version__: str
else:

    def __getattr__(name: str) -> object:
        """Look up a name of the library (PEP 562)."""
        if name == "__version__":
            from importlib.metadata import version

            return version("noack")
        module = next((module for module, names in _NAMES.items() if name in names), None)
        if module is None:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        if name in _ON_LINUX:
            from netem.core.core_library import require_live_runs

            require_live_runs()
        value = getattr(import_module(module), name)
        if value.__module__.startswith(("cosim.", "netem.")):
            value.__module__ = __name__  # what `help(noack.simulate)` shows
        globals()[name] = value
        return value

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__, *_NOT_IN_STAR})


_NAMES = {
    "cosim.analysis.certificates": ("Certificates",),
    "cosim.api.analyses": ("certify", "cost", "margin"),
    "cosim.api.campaigns": ("CampaignResult", "campaign"),
    "cosim.api.exact_runs": ("ExactRun", "simulate_exactly"),
    "cosim.api.measurements": ("Measurement", "measure"),
    "cosim.api.runs": ("Run", "compare", "open_run", "run", "simulate"),
    "cosim.api.scenarios": ("from_system", "load", "scenarios", "with_settings"),
    "cosim.api.tables": ("save_tables",),
    "cosim.api.virtual_network": ("VirtualNetwork",),
    "cosim.live.followed_run": ("follow",),
    "cosim.live.monitoring.run_observers": ("RunObserver",),
    "cosim.output.curves": ("Curve", "CurveStyle"),
    "cosim.output.export.export_formats": ("ExportedRun",),
    "cosim.studies.new_loop.linear_model": ("gain", "linearise"),
    "cosim.studies.new_loop.new_scenario": ("new",),
    "netem.lossy_udp": ("LossyUdp",),
    "netem.core.errors": ("NoackError",),
    "noack.scenario.scenario": ("Scenario",),
}
"""The names of the library, by module."""
_ON_LINUX = ("LossyUdp", "follow")
__all__ = [
    "CampaignResult", "Certificates", "Curve", "CurveStyle", "ExactRun", "Measurement", "NoackError",
    "Run", "RunObserver", "Scenario", "VirtualNetwork", "__version__", "campaign", "certify", "compare",
    "cost", "from_system", "gain", "linearise", "load", "margin", "measure", "new", "open_run", "run",
    "save_tables", "scenarios", "simulate", "simulate_exactly", "with_settings",
]  # fmt: skip
_NOT_IN_STAR = ("ExportedRun", "LossyUdp", "follow")
"""Names that are for extensions, or need Linux: no star import takes them."""
