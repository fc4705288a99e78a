"""Gymnasium for noack: environments as plants, and noack's network around an environment.

:class:`LossyChannel` is loaded when it is used: a process of a run needs the plant alone.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from noack_gymnasium.lossy_channel import LossyChannel as LossyChannel
else:

    def __getattr__(name: str) -> object:
        """Look up the wrapper (PEP 562)."""
        if name != "LossyChannel":
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from noack_gymnasium.lossy_channel import LossyChannel

        return LossyChannel


__all__ = ["LossyChannel"]
