# ruff: noqa: F405
"""What every process agrees on: scenario, wire format, linear systems, records, clock.

To a program or a notebook, ``import noack`` is the laboratory, too: scenarios, runs, certificates
(``docs/library.md``). Those names lead to :mod:`cosim.api`, which stands above everything, and are
looked up when they are first used: a process that imports a module from here loads nothing else.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cosim.api import *  # noqa: F403
    from cosim.api import __version__  # a star leaves it out
else:

    def __getattr__(name: str) -> object:
        """Look up a name of the library (PEP 562)."""
        if name not in (*__all__, *_NOT_EVERYWHERE):
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from cosim import api  # upward, and it takes time: for programs only

        value = globals()[name] = getattr(api, name)
        return value

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__, *_NOT_EVERYWHERE})


__all__ = [
    "CampaignResult", "Certificates", "Curve", "CurveStyle", "ExactRun", "Measurement", "NoackError",
    "Run", "RunObserver", "Scenario", "VirtualNetwork", "__version__", "campaign", "certify", "compare",
    "cost", "from_system", "gain", "linearise", "load", "margin", "measure", "new", "open_run", "run",
    "save_tables", "scenarios", "simulate", "simulate_exactly", "with_settings",
]  # fmt: skip
_NOT_EVERYWHERE = ("ExportedRun", "LossyUdp", "follow")
"""Names that are for extensions, or need Linux: no star import takes them."""
