"""A loop whose settings one changes to see what follows, in a program or a notebook."""

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import noack
from noack.extend import CallerError, new_file
from noack_lab import results
from noack_lab.scenario_draft import Draft, draft_of, open_draft

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WIDTH_IN, _PANEL_IN = 8.0, 1.9


class Explorer:
    """A scenario and what follows from its settings; :func:`noack_lab.explore` returns it.

    Results are computed when they are first asked for, and anew after a change.
    """

    def __init__(self, draft: Draft) -> None:
        self._take(draft)

    def _take(self, draft: Draft) -> None:
        if draft.scenario.loops:
            raise CallerError("loops: only one loop can be explored; noack.simulate takes several")
        self._draft = draft
        for name in ("run", "certificate", "margin"):
            self.__dict__.pop(name, None)

    @property
    def scenario(self) -> noack.Scenario:
        """The scenario with its settings, for :func:`noack.simulate` and the other functions."""
        return self._draft.scenario

    @property
    def toml(self) -> str:
        """The text of the scenario's file."""
        return self._draft.text

    @cached_property
    def run(self) -> results.ShownRun:
        """The run: ``curves``, ``facts`` (key numbers), ``verdict``; exact where that is covered."""
        return results.run_of(self.scenario)

    @cached_property
    def certificate(self) -> results.Guarantee:
        """What is guaranteed: ``line`` in words, ``curves`` of the bounds, ``facts``."""
        return results.guarantee_of(self.scenario)

    @cached_property
    def margin(self) -> str:
        """With how many losses in a row the loop is stable for every pattern; this may take minutes."""
        return results.margin_of(self.scenario)

    def set(self, settings: Mapping[str, object]) -> None:
        """Change settings; if one is wrong, all stay as they are.

        Args:
            settings: values by the keys of a scenario file, as for :func:`noack.with_settings`;
                None restores the default of a key.

        Raises:
            NoackError: one line per mistake, each with key, value and remedy.
        """
        draft = self._draft
        for key, value in settings.items():
            plain = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
            draft = draft.with_value(key, plain)
        self._take(draft)

    def figure(self, state: str = "") -> "Figure":
        """Draw the run with its certified bounds.

        Args:
            state: name of the state that is drawn; by default the first.
        """
        from matplotlib.figure import Figure

        names, curves = self.run.states, [*self.run.curves, *self.certificate.curves]
        state = state or names[0]
        panels = [
            panel
            for panel in dict.fromkeys(curve.panel for curve in curves)
            if panel == state or panel not in names
        ]
        figure = Figure((_WIDTH_IN, _PANEL_IN * len(panels)), layout="constrained")
        axes: Any = figure.subplots(len(panels), sharex=True, squeeze=False)[:, 0]
        for ax, panel in zip(axes, panels, strict=True):
            _draw(ax, results.panel_title(panel, curves), [curve for curve in curves if curve.panel == panel])
        axes[-1].set_xlabel("time t [s]")
        return figure

    def save(self, path: str | Path) -> Path:
        """Write the scenario as TOML, with the comments of the file that it came from."""
        with new_file(Path(path)) as file:
            file.write(self.toml.encode())
        return Path(path)

    def __repr__(self) -> str:
        lines = [f"{label}: {value}" for label, value in self.run.facts]
        return "\n".join([self.scenario.name, *lines, results.kept_line(self.run, self.certificate).text])


def _draw(ax: "Axes", title: str, curves: list[noack.Curve]) -> None:
    """Draw the curves of a panel."""
    for curve in curves:
        style = curve.style
        values = curve.values
        if curve.is_logarithmic:
            values = np.where(values > 0, values, np.nan)
        ax.plot(
            curve.t_s,
            values,
            label=curve.name,
            color=tuple(part / 255 for part in style.colour),
            linewidth=style.width,
            linestyle="none" if style.marker else (0, style.dash) if style.dash else "-",
            marker=style.marker or None,
            drawstyle="steps-post" if style.is_held else "default",
        )
    unit = f" [{curves[0].unit}]" if curves[0].unit else ""
    ax.set_title(f"{title}{unit}", loc="left", fontsize="medium")
    if curves[0].is_logarithmic:
        ax.set_yscale("log")
    ax.legend(loc="upper right", fontsize="small")


def explore(source: Any, settings: Mapping[str, object] | None = None) -> Explorer:
    """Explore a loop: change settings and see what follows, as on the page of ``noack lab``.

    >>> import noack_lab
    >>> explorer = noack_lab.explore("lane_following")
    >>> len(explorer.run.transmissions)
    20
    >>> explorer.set({"network.loss.probability": 0.0, "trigger.beta": 1.0})
    >>> len(explorer.run.transmissions), explorer.scenario.trigger.beta
    (6, 1.0)

    Args:
        source: as for :func:`noack.load`.
        settings: values that replace the source's, as in :func:`noack.with_settings`.

    Raises:
        NoackError: one line per mistake, each with key, value and remedy; or the scenario has
            several loops.
    """
    named = isinstance(source, str | Path)
    explorer = Explorer(open_draft(str(source)) if named else draft_of(noack.load(source)))
    if settings:
        explorer.set(settings)
    return explorer
