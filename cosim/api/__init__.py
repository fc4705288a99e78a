"""The library: the names that ``import noack`` offers to programs and notebooks.

``docs/library.md`` documents it. The import loads neither viewer nor control plane nor plots. Each
function imports these modules when it is first called.
"""

from importlib.metadata import version

from cosim.analysis.certificates import Certificates as Certificates
from cosim.api.explorer import Explorer as Explorer
from cosim.api.explorer import explore as explore
from cosim.api.runs import Run as Run
from cosim.api.runs import compare as compare
from cosim.api.runs import open_run as open_run
from cosim.api.runs import reproduce as reproduce
from cosim.api.runs import run as run
from cosim.api.runs import simulate as simulate
from cosim.api.scenarios import from_system as from_system
from cosim.api.scenarios import load as load
from cosim.api.scenarios import with_settings as with_settings
from cosim.api.studies import CampaignResult as CampaignResult
from cosim.api.studies import Measurement as Measurement
from cosim.api.studies import campaign as campaign
from cosim.api.studies import certify as certify
from cosim.api.studies import margin as margin
from cosim.api.studies import measure as measure
from cosim.api.studies import save_tables as save_tables
from cosim.studies.new_loop.linear_model import gain as gain
from cosim.studies.new_loop.linear_model import linearise as linearise
from cosim.studies.new_loop.new_scenario import new as new
from noack.core.errors import NoackError as NoackError
from noack.scenario.scenario import Scenario as Scenario

__version__ = version("noack")

# `help(noack.simulate)` names the module that programs import.
for _public in list(globals().values()):
    if getattr(_public, "__module__", "").startswith("cosim."):
        _public.__module__ = "noack"
