"""The figure of the losses that occurred, beside what the guarantee allows."""

import math
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from cosim.output import palette
from cosim.output.report import axes as draw
from cosim.output.report.figure_style import NotebookFigure, printed, styled

_HEIGHT_IN, _NARROWEST_IN, _WIDEST_IN = 1.9, 2.2, 5.0
_MOST_LABELS = 12
_LOST, _LIMIT = printed(palette.LOST), printed(palette.CERTIFIED)


class LossPanel(NamedTuple):
    """One histogram of whole numbers, with the largest number that the guarantee allows."""

    title: str
    what: str
    """Label of the horizontal axis."""
    counted: str
    """Label of the vertical axis."""
    values: NDArray[np.int64]
    """(k,)"""
    limit: int | None


@styled
def loss_figure(panels: Sequence[LossPanel]) -> Figure:
    """Draw histograms side by side."""
    space, above_in = draw.layout(), draw.head_in([])
    columns = min(len(panels), int(space.width_in / _NARROWEST_IN))
    rows, height_in = math.ceil(len(panels) / columns), _HEIGHT_IN * space.scale
    row_in = above_in + height_in + space.below_in
    figure = NotebookFigure(figsize=(space.width_in, rows * row_in))
    share_in = (space.width_in - space.right_in) / columns
    width_in = min(share_in - space.left_in, _WIDEST_IN)
    for place, panel in enumerate(panels):
        row, column = divmod(place, columns)
        at_in = space.left_in + column * share_in, row * row_in + above_in
        _histogram(draw.place(figure, *at_in, width_in, height_in), panel)
    return figure


def _histogram(axes: Axes, panel: LossPanel) -> None:
    counts = Counter(panel.values.tolist())
    numbers = sorted(counts)
    heights = [counts[number] for number in numbers]
    axes.bar(numbers, heights, width=0.8, color=_LOST)
    axes.set(title=panel.title, xlabel=panel.what, ylabel=panel.counted)
    axes.margins(y=0.15)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.yaxis.set_major_locator(MaxNLocator(integer=True, nbins=5))
    axes.grid(visible=False, axis="x")
    if len(numbers) <= _MOST_LABELS:
        for number, height in zip(numbers, heights, strict=True):
            axes.text(
                number, height, f"{height:,}", ha="center", va="bottom", size=draw.layout().text_pt
            )
    limit = numbers[-1] if panel.limit is None and numbers else panel.limit or 0
    low = min([1, *numbers])
    axes.set_xlim(low - 0.6, max([limit, *numbers]) + 0.9)
    if panel.limit is not None:
        axes.axvline(panel.limit + 0.5, color=_LIMIT, linestyle=(0, (6, 2.5)), linewidth=1.6)
    if not numbers:
        axes.text(0.5, 0.5, "no loss", transform=axes.transAxes, ha="center", va="center")
        axes.tick_params(left=False, labelleft=False, which="both")
