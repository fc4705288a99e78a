"""The lab: a page in the browser, and an explorer for notebooks, on top of ``import noack``.

``lab_command.py`` is ``noack lab``. ``lab_server.py`` serves ``lab_page.py``, which computes by
``results.py`` and draws by ``chart.py``; ``scenario_draft.py`` is the edited scenario, ``sliders.py``
what can be dragged of it, ``live_run.py`` a live run in processes of its own. :func:`explore`
(``explorer.py``) offers the same to a notebook or a program. It is loaded when it is used: every
command of noack reads ``lab_command.py``.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from noack_lab.explorer import Explorer as Explorer
    from noack_lab.explorer import explore as explore
else:

    def __getattr__(name: str) -> object:
        """Look up the explorer (PEP 562)."""
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from noack_lab import explorer

        return getattr(explorer, name)


__all__ = ["Explorer", "explore"]
