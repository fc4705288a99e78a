"""The library: what ``import noack`` gives to programs and notebooks (``docs/library.md``).

Importing it loads neither viewer nor control plane nor plots: what a function needs beyond the
scenario comes with its first call.
"""

from importlib.metadata import version

from cosim.lab.certificates import Certificates, certify
from cosim.lab.runs import Run, compare, open_run, run, simulate
from cosim.lab.scenarios import from_system, load, with_settings
from noack.errors import NoackError
from noack.scenario import Scenario

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
