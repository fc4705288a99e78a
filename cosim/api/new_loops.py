"""From a plant to a scenario: its linear model, a gain, a complete scenario file."""

from collections.abc import Sequence
from os import PathLike
from pathlib import Path

from cosim.lazy_modules import lazy_modules
from noack.core.errors import CallerError
from noack.settings.section import ReadTable

with lazy_modules():
    from cosim.studies.new_loop import linear_model, loop_gain, new_scenario

Weights = float | Sequence[float]


def linearise(
    plant: str,
    *,
    at: Sequence[float] | None = None,
    input: Sequence[float] | None = None,  # noqa: A002 # the option of the command
    settings: ReadTable | None = None,
    within: float = 0.1,
) -> "linear_model.LinearModel":
    """Linearise a plant about a point.

    >>> import noack
    >>> found = noack.linearise("cart_pole")
    >>> found.rank, found.A[3, 2].round(2)
    (4, np.float64(31.18))

    Args:
        plant: ``"file.py:Class"``, ``"file.fmu"``, ``"gymnasium:ID"``, a kind of plant, a scenario,
            or a file that ``noack linearise`` wrote.
        at: x at the point, n entries; by default 0.
        input: u there, m entries; by default 0.
        settings: values by the keys of a scenario, e.g. ``{"plant.system.cart_kg": 1.0}``.
        within: half-width of the neighbourhood in which the error is sampled, in each coordinate's
            units; a tenth of it is sampled, too.

    Raises:
        NoackError: there is no such plant, or it has no linear model there.
    """
    return linear_model.linear_model(plant, at=at, held=input, settings=settings, within=within)


def gain(
    plant: "str | linear_model.LinearModel",
    *,
    q: Weights | None = None,
    r: Weights | None = None,
    poles: Sequence[complex] | None = None,
    settings: ReadTable | None = None,
) -> "loop_gain.LoopGain":
    """Compute the gain K of u = K x for a plant: a linear-quadratic regulator, or given poles.

    Args:
        plant: a linear model, or a plant as for :func:`linearise`.
        q: weight of the states, a number or the diagonal; by default 1.
        r: weight of the inputs, likewise.
        poles: eigenvalues of the controllable part of Â + B̂K instead of the weights.
        settings: as for :func:`linearise`.

    Raises:
        NoackError: an unstable eigenvalue is not controllable, or a value is wrong.
    """
    model = linearise(plant, settings=settings) if isinstance(plant, str) else plant
    return loop_gain.loop_gain(model, q=q, r=r, poles=poles)


def new(
    plant: "str | linear_model.LinearModel | loop_gain.LoopGain",
    path: str | PathLike[str] = "new.toml",
    *,
    initial_state: Sequence[float] | None = None,
    settings: ReadTable | None = None,
) -> "new_scenario.NewScenario":
    """Choose a complete scenario for a plant; its ``save`` writes the file.

    Args:
        plant: a gain with its model; a model or a plant, for which K is chosen; or the file of one.
        path: the file that the scenario will have; file names in it are relative to its folder.
        initial_state: x(0), n entries; by default chosen.
        settings: values by the keys of a scenario that are not to be chosen.

    Raises:
        NoackError: the plant does not rest at x = 0, u = 0, or a value is wrong.
    """
    return new_scenario.new_scenario(
        model_or_gain(plant, settings), Path(path), initial_state=initial_state, settings=settings
    )


def model_or_gain(
    plant: "str | linear_model.LinearModel | loop_gain.LoopGain", settings: ReadTable | None
) -> "linear_model.LinearModel | loop_gain.LoopGain":
    """Return a model, with its gain if the plant or its file has one."""
    if not isinstance(plant, str):
        return plant
    if not plant.endswith(".json"):
        return linearise(plant, settings=settings)
    if any(key.startswith("plant.system") for key in settings or ()):
        raise CallerError(f"{plant}: it has the plant's settings; linearise the plant again")
    return loop_gain.read_gain(plant)
