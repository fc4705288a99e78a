"""The library: the names that ``import noack`` offers to programs and notebooks.

``docs/library.md`` documents it. The import loads neither viewer nor control plane nor plots. Each
function imports these modules when it is first called.
"""

from importlib.metadata import version

from cosim.api.certificates import certify
from cosim.api.runs import Run, compare, open_run, run, simulate
from cosim.api.scenarios import from_system, load, with_settings
from cosim.output.certificate_report import Certificates
from noack.config.scenario import Scenario
from noack.core.errors import NoackError

__version__ = version("noack")

__all__ = [
    "Certificates",
    "NoackError",
    "Run",
    "Scenario",
    "__version__",
    "certify",
    "compare",
    "from_system",
    "load",
    "open_run",
    "run",
    "simulate",
    "with_settings",
]
