"""A loop whose settings one changes to see what follows, in a program or a notebook."""

from collections.abc import Callable, Mapping
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.api.scenarios import Source, load, plain
from cosim.interactive.draft import Draft, draft_of, open_draft
from cosim.output.row_display import as_text
from noack.core.errors import CallerError, NoackError
from noack.core.file_access import write_whole

if TYPE_CHECKING:
    from ipywidgets import Widget
    from matplotlib.figure import Figure

    from cosim.interactive.ensemble import Ensemble
    from cosim.interactive.exploration import Exploration
    from cosim.interactive.figure_curves import Shown
    from cosim.interactive.scenario_guarantee import Guarantee, Margin
    from noack.config.scenario import Scenario


class Explorer:
    """A scenario and what follows from its settings; :func:`noack.explore` returns it.

    Results are computed when they are first asked for, and anew after a change. A notebook shows
    the explorer as sliders beside the figure.
    """

    def __init__(self, draft: Draft) -> None:
        self._draft = draft
        self._found: dict[str, Any] = {}
        self._listeners: list[Callable[[], None]] = []
        self._widget: Widget | None = None

    @property
    def scenario(self) -> "Scenario":
        """The scenario with its settings, for :func:`noack.simulate` and the other functions."""
        return self._draft.scenario

    @property
    def draft(self) -> Draft:
        """The scenario as it is edited."""
        return self._draft

    @property
    def toml(self) -> str:
        """The text of the scenario's file."""
        return self._draft.text

    @property
    def run(self) -> "Exploration":
        """The run: states ``x``, ``x_s``, ``x_c`` (N, n), norms and times ``t_s`` (N,), events.

        It is exact, in continuous time, where the exact simulation covers the scenario; else it is
        simulated in virtual time.
        """
        from cosim.interactive.run_exploration import run_of

        return self._once("run", run_of)  # type: ignore[no-any-return]

    @property
    def numbers(self) -> dict[str, str]:
        """The key numbers of the run, as texts by their labels."""
        return dict(self.run.numbers)

    @property
    def certificate(self) -> "Guarantee":
        """What is guaranteed: ``verdict``, ``reason``, and bounds ``e_s``, ``e_c``, ``x`` (N,).

        It has the constants as texts, too; :func:`noack.certify` gives them as numbers.
        """
        from cosim.interactive.scenario_guarantee import certify

        return self._once("certificate", certify)  # type: ignore[no-any-return]

    @property
    def ensemble(self) -> "Ensemble | None":
        """Bands over 200 draws of plant, x(0) and losses; None without exact simulation."""
        from cosim.interactive.ensemble import explore_ensemble
        from cosim.interactive.exploration import why_not_exact

        if why_not_exact(self.scenario) is not None:
            return None
        return self._once("ensemble", explore_ensemble)  # type: ignore[no-any-return]

    @property
    def margin(self) -> "Margin":
        """For which M the loop is stable under every loss pattern; this may take seconds."""
        from cosim.interactive.scenario_guarantee import margin_of

        return self._once("margin", margin_of)  # type: ignore[no-any-return]

    @property
    def warning(self) -> str:
        """In words: whether the loop is unstable, and why nothing is guaranteed; else empty."""
        from cosim.interactive.scenario_guarantee import warning

        return warning(self.run, self.certificate, self._found.get("margin"))

    def set(self, settings: Mapping[str, Any]) -> None:
        """Change settings; if one is wrong, all stay as they are.

        Args:
            settings: values by the keys of a scenario file, as for :func:`noack.with_settings`;
                None restores the default of a key.

        Raises:
            NoackError: one line per mistake, each with key, value and remedy.
        """
        load(self.scenario, settings)  # its messages name the settings
        draft = self._draft
        for key, value in settings.items():
            draft = draft.without(key) if value is None else draft.with_value(key, plain(value))
        self.take(draft)

    def take(self, draft: Draft) -> None:
        """Take another draft of the scenario, which is valid."""
        _require_one_loop(draft)
        self._draft, self._found = draft, {}
        for listener in self._listeners:
            listener()

    def figure(self, state: int | str = -1) -> "Figure":
        """Draw the run with all that was computed until now, and the certificate.

        Args:
            state: the state in the first panel, by name or number from 0 on; by default the last.

        Raises:
            NoackError: there is no such state.
        """
        from cosim.interactive.exploration_figure import exploration_figure

        _ = self.certificate
        return exploration_figure(self.shown(self._state(state)))

    def known(self) -> frozenset[str]:
        """Return which results are computed: run, certificate, ensemble, margin."""
        return frozenset(self._found)

    def shown(self, state: int) -> "Shown":
        """Return what a figure shows of the results that are computed."""
        from cosim.interactive.figure_curves import Shown

        found = self._found
        return Shown(self.run, state, found.get("ensemble"), found.get("certificate"))

    def save(self, path: str | PathLike[str]) -> Path:
        """Write the scenario as TOML, with the comments of the file that it came from.

        Raises:
            NoackError: the file cannot be written.
        """
        write_whole(Path(path), self.toml.encode())
        return Path(path)

    def widget(self) -> "Widget":
        """Return sliders and choices beside the figure, as an ``ipywidgets.Widget``.

        Raises:
            NoackError: ipywidgets is not installed.
        """
        if self._widget is None:
            try:
                from cosim.api.explorer_widget import ExplorerWidget
            except ModuleNotFoundError as error:
                if error.name != "ipywidgets":
                    raise
                raise CallerError(
                    "sliders need ipywidgets: pip install 'noack[notebook]'; set() and figure() "
                    "work without it"
                ) from None
            view = ExplorerWidget(self)
            self._listeners.append(view.show)
            self._widget = view.whole
        return self._widget

    def _once(self, name: str, compute: Callable[["Scenario"], Any]) -> Any:
        if name not in self._found:
            self._found[name] = compute(self.scenario)
        return self._found[name]

    def _state(self, state: int | str) -> int:
        names = self.run.state_names
        if state in names:
            return names.index(str(state))
        if isinstance(state, int) and -len(names) <= state < len(names):
            return state % len(names)
        raise CallerError(f"state: {state!r}: no such state; there are {', '.join(names)}")

    def __repr__(self) -> str:
        found = self.certificate
        rows = [("scenario", self.scenario.name), *self.run.numbers,
                ("certificate", f"{found.verdict}: {found.reason}")]  # fmt: skip
        return as_text([*rows, *([("warning", self.warning)] if self.warning else [])])

    def _ipython_display_(self) -> None:
        from IPython.display import display

        try:
            display(self.widget())  # type: ignore[no-untyped-call]
        except NoackError as error:
            print(f"{self!r}\n{error}")


def explore(source: Source, settings: Mapping[str, Any] | None = None) -> Explorer:
    """Explore a loop: change settings and see what follows, as on the page of ``noack lab``.

    At the end of a notebook's cell the explorer shows sliders beside the figure, which follows
    while they are dragged (``pip install 'noack[notebook]'``).

    >>> import noack
    >>> explorer = noack.explore("lane_following")
    >>> explorer.numbers["transmissions"], explorer.certificate.verdict
    ('20', 'certified')
    >>> explorer.set({"network.loss.probability": 0.0, "trigger.beta": 1.0})
    >>> explorer.numbers["transmissions"]
    '7'
    >>> explorer.scenario.trigger.beta
    1.0

    Args:
        source: as for :func:`noack.load`.
        settings: values that replace the source's, as in :func:`noack.with_settings`.

    Raises:
        NoackError: one line per mistake, each with key, value and remedy; or the scenario has
            several loops.
    """
    scenario = load(source)
    draft = open_draft(str(source)) if isinstance(source, str | PathLike) else draft_of(scenario)
    _require_one_loop(draft)
    explorer = Explorer(draft)
    if settings:
        explorer.set(settings)
    return explorer


def _require_one_loop(draft: Draft) -> None:
    if draft.scenario.loops is not None:
        raise CallerError("loops: a scenario of several loops cannot be explored; noack.simulate")
