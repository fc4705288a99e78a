"""The lab: a page in the browser, and an explorer for notebooks, on top of ``import noack``.

``lab_command.py`` is ``noack lab``. ``lab_server.py`` serves ``lab_page.py``, which computes by
``results.py`` and draws by ``chart.py``; ``scenario_draft.py`` is the edited scenario, ``sliders.py``
what can be dragged of it, ``live_run.py`` a live run in processes of its own. :func:`explore`
(``explorer.py``) offers the same to a notebook or a program.
"""

from noack_lab.explorer import Explorer as Explorer
from noack_lab.explorer import explore as explore

__all__ = ["Explorer", "explore"]
