"""A loop whose settings one changes to see what follows, in a program or a notebook."""

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from cosim.api.scenarios import Source, load, plain
from cosim.lazy_modules import lazy_modules
from noack.core.errors import CallerError
from noack.core.file_access import write_whole
from noack.core.number_format import as_text

with lazy_modules():
    from cosim.interactive import draft_results, exploration_figure
    from cosim.interactive import scenario_draft as drafts
    from cosim.output.figures import figure_drawing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from cosim.interactive.exploration import Ensemble, Exploration
    from cosim.interactive.scenario_guarantee import Guarantee, Margin
    from noack.scenario.scenario import Scenario


class Explorer:
    """A scenario and what follows from its settings; :func:`noack.explore` returns it.

    Results are computed when they are first asked for, and anew after a change.
    """

    def __init__(self, results: "draft_results.DraftResults") -> None:
        self._results = results

    @property
    def scenario(self) -> "Scenario":
        """The scenario with its settings, for :func:`noack.simulate` and the other functions."""
        return self._results.draft.scenario

    @property
    def toml(self) -> str:
        """The text of the scenario's file."""
        return self._results.draft.text

    @property
    def run(self) -> "Exploration":
        """The run: times ``t_s`` (N,), states ``x``, ``x_s``, ``x_c`` (N, n), norms, events.

        It is exact, in continuous time, where the exact simulation covers the scenario; else it is
        simulated in virtual time.
        """
        return self._results.run

    @property
    def numbers(self) -> dict[str, str]:
        """The key numbers of the run, as texts by their labels."""
        return dict(self.run.numbers)

    @property
    def certificate(self) -> "Guarantee":
        """What is guaranteed: ``verdict``, ``reason``, bounds ``e_s``, ``e_c``, ``x`` at ``t_s``.

        It has the constants as texts; :func:`noack.certify` gives them as numbers.
        """
        return self._results.certificate

    @property
    def ensemble(self) -> "Ensemble | None":
        """Bands over 200 draws of plant, x(0) and losses; None without exact simulation."""
        return self._results.ensemble

    @property
    def margin(self) -> "Margin":
        """For which M the loop is stable under every loss pattern; this may take seconds."""
        return self._results.margin

    @property
    def warning(self) -> str:
        """In words: whether the loop is unstable, and why nothing is guaranteed; else empty."""
        self._results.compute_certificate()
        return self._results.warning

    def set(self, settings: Mapping[str, object]) -> None:
        """Change settings; if one is wrong, all stay as they are.

        Args:
            settings: values by the keys of a scenario file, as for :func:`noack.with_settings`;
                None restores the default of a key.

        Raises:
            NoackError: one line per mistake, each with key, value and remedy.
        """
        load(self.scenario, settings)  # its messages name the settings
        draft = self._results.draft
        for key, value in settings.items():
            draft = draft.without(key) if value is None else draft.with_value(key, plain(value))
        self._results.take(draft)

    def figure(self, state: int | str = -1) -> "Figure":
        """Draw the run with its certificate, and the bands if they were computed.

        Args:
            state: the state in the first panel, by name or number from 0 on; by default the last.

        Raises:
            NoackError: there is no such state.
        """
        self._results.compute_certificate()
        content = self._results.explored_run(self._state(state))
        return figure_drawing.draw(exploration_figure.exploration_figure(content))

    def save(self, path: str | PathLike[str]) -> Path:
        """Write the scenario as TOML, with the comments of the file that it came from.

        Raises:
            NoackError: the file cannot be written.
        """
        write_whole(Path(path), self.toml.encode())
        return Path(path)

    def _state(self, state: int | str) -> int:
        names = self.run.state_names
        if state in names:
            return names.index(str(state))
        if isinstance(state, int) and -len(names) <= state < len(names):
            return state % len(names)
        raise CallerError(f"state: {state!r}: no such state; there are {', '.join(names)}")

    def __repr__(self) -> str:
        certificate = self.certificate
        rows = [
            ("scenario", self.scenario.name),
            *self.run.numbers,
            ("certificate", f"{certificate.verdict}: {certificate.reason}"),
        ]
        return as_text([*rows, *([("warning", self.warning)] if self.warning else [])])


def explore(source: Source, settings: Mapping[str, object] | None = None) -> Explorer:
    """Explore a loop: change settings and see what follows, as on the page of ``noack lab``.

    >>> import noack
    >>> explorer = noack.explore("lane_following")
    >>> explorer.numbers["transmissions"], explorer.certificate.verdict
    ('20', 'certified')
    >>> explorer.set({"network.loss.probability": 0.0, "trigger.beta": 1.0})
    >>> explorer.numbers["transmissions"]
    '6'
    >>> explorer.scenario.trigger.beta
    1.0

    Args:
        source: as for :func:`noack.load`.
        settings: values that replace the source's, as in :func:`noack.with_settings`.

    Raises:
        NoackError: one line per mistake, each with key, value and remedy; or the scenario has
            several loops.
    """
    scenario = load(source)  # its messages name the source
    is_name = isinstance(source, str | PathLike)
    draft = drafts.open_draft(str(source)) if is_name else drafts.draft_of(scenario)
    explorer = Explorer(draft_results.DraftResults(draft))
    if settings:
        explorer.set(settings)
    return explorer
