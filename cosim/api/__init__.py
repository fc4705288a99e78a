"""The library: what ``import noack`` gives to programs and notebooks (``docs/library.md``).

Importing it loads neither viewer nor control plane nor plots: what a function needs beyond the
scenario comes with its first call.
"""

from importlib.metadata import version

from cosim.api.certificates import Certificates, certify
from cosim.api.runs import Run, compare, open_run, run, simulate
from cosim.api.scenarios import from_system, load, with_settings
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
