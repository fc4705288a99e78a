"""The colour key: one panel instead of a legend in each plot."""

from collections.abc import Mapping, Sequence

import rerun.blueprint as rrb

from cosim.output import palette
from cosim.output.viewer.pictures.picture import Shape, label, lines

COLOUR_KEY = "key"
"""Parent of all entities of the key."""

_WIDE, _HIGH = 18.0, 1.2
_MOST_IN_A_ROW = 6
_HALF, _THICK = 0.7, 0.16
_DIAMOND = ((0.0, 0.3), (0.2, 0.1), (0.0, -0.1), (-0.2, 0.1), (0.0, 0.3))
_CROSS = ((-0.16, 0.26), (0.16, -0.06), (0.0, 0.1), (0.16, 0.26), (-0.16, -0.06))
_STROKE = ((-_HALF, 0.0), (_HALF, 0.0))
_Entry = tuple[str, palette.Colour, Sequence[tuple[float, float]]]
"""Name, colour, and line of the sample."""
_ROWS: tuple[tuple[_Entry, ...], ...] = (
    (
        ("plant: x", palette.PLANT, _STROKE),
        ("sensor: x_s, ‖e_s‖, sent", palette.SENSOR, _STROKE),
        ("controller: x_c, ‖e_c‖, received", palette.CONTROLLER, _STROKE),
    ),
    (
        ("threshold", palette.THRESHOLD, _STROKE),
        ("bound from (I1)", palette.IDENTITY, _STROKE),
        ("certified bound", palette.CERTIFIED, _STROKE),
    ),
    (
        ("lost", palette.LOST, _CROSS),
        ("delivery forced", palette.FORCED, _DIAMOND),
        ("network", palette.NETWORK, _STROKE),
    ),
)


def input_colour(i: int) -> palette.Colour:
    """Return the colour of the i-th control input."""
    return palette.SERIES[i % len(palette.SERIES)]


class ColourKey:
    """Samples of lines and marks, with their names.

    Args:
        input_names: names of the control inputs; a single input needs no entry.
    """

    def __init__(self, input_names: Sequence[str]) -> None:
        names = input_names if len(input_names) > 1 else ()
        inputs = [(name, input_colour(i), _STROKE) for i, name in enumerate(names)]
        self._rows = [
            *_ROWS,
            *(inputs[i : i + _MOST_IN_A_ROW] for i in range(0, len(inputs), _MOST_IN_A_ROW)),
        ]

    def panel(self) -> rrb.Spatial2DView:
        """The view of the key."""
        return rrb.Spatial2DView(
            origin=COLOUR_KEY,
            name="Colours",
            visual_bounds=rrb.VisualBounds2D(
                x_range=[0.0, _WIDE], y_range=[-0.4, len(self._rows) * _HIGH]
            ),
        )

    def scenery(self) -> Mapping[str, Shape]:
        """The samples and names, by entity."""
        found: dict[str, Shape] = {}
        for i, row in enumerate(self._rows):
            for j, (name, colour, sample) in enumerate(row):
                x, y = (j + 0.5) * _WIDE / len(row), -i * _HIGH
                moved = [(x + dx, y + dy) for dx, dy in sample]
                found[f"{i}/{j}/sample"] = lines([moved], colour, _THICK)
                found[f"{i}/{j}/name"] = label(name, (x, y - 0.2), colour)
        return found
