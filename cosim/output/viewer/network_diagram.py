"""The loop as a diagram that animates every update until it arrives or is lost.

A real transmission takes microseconds. Each leg is drawn with a duration of ``LEG_S`` of simulated
time, so that it is visible at the speed of the run: a dot leaves the sensor at the transmission,
and the effect of the delivery on the states appears before the dot arrives.
"""

from collections.abc import Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from cosim.output.figures.palette import CONTROLLER, FORCED, LOST, NETWORK, PLANT, SENSOR
from cosim.output.viewer.pictures.picture import STILL, Columns, Shape, label, lines, style, upright
from cosim.record.align import Reals, Times
from netem.core.clock import NS_PER_S
from netem.core.packet_rows import Fate, effective
from noack.protocol.wire_format import Flow

DIAGRAM = "network"
LEG_S = 0.15
"""Drawn duration, in simulated time, from the sensor to the network, and from there onward."""
_FALL_S = 0.45
"""Drawn duration of the fall of a lost packet."""
_SPACING_S = 0.025
"""Least time between the transmissions of two packets that are drawn."""
_LEG_NS, _FALL_NS, _SPACING_NS = (round(s * NS_PER_S) for s in (LEG_S, _FALL_S, _SPACING_S))
_FRAME_NS = round(NS_PER_S / 60)

_BOX_DISTANCE = 4.4
_BOXES = {name: i * _BOX_DISTANCE for i, name in enumerate(("plant", "sensor", "network", "controller"))}
_, _SENSOR, _NETWORK, _CONTROLLER = _BOXES.values()
_HALF_WIDE, _HALF_HIGH = 1.6, 0.62
"""Half-sizes of a box."""
_REVERSE_Y = -0.4
"""Height of acknowledgements, a little below the updates."""
_INPUT_Y = -2.5
"""Height of the way from the controller to the plant."""
_DOT_RADIUS = 0.17


class Moving(NamedTuple):
    """Rows of one entity: columns at times (r,)."""

    t_ns: Times
    columns: Columns


_PACKET = np.dtype([("t_ns", "i8"), ("out_ns", "i8"), ("fate", "i8"), ("reverse", "?")])
"""A packet in the drawing: time of its transmission; time at which it leaves the network, or, if it
is lost, starts to fall; its fate; whether it is sent from the controller to the sensor."""


class NetworkDiagram:
    """Boxes, arrows between them, and packets.

    Args:
        reverse: what the controller sends through the network: acknowledgements or actuations, if
            anything.
    """

    def __init__(self, reverse: Flow | None = None) -> None:
        self._reverse = reverse
        self._in_flight = np.zeros(0, _PACKET)
        self._drawn_ns = -1
        self._last_ns = {False: -_SPACING_NS, True: -_SPACING_NS}
        self._shape_counts: dict[str, int] = {}

    @staticmethod
    def panel() -> rrb.Spatial2DView:
        """Return the view of the diagram."""
        return rrb.Spatial2DView(
            origin=DIAGRAM,
            name=f"Packets (animated {LEG_S:g} s per hop)",
            visual_bounds=rrb.VisualBounds2D(
                x_range=[-1.9, _CONTROLLER + 1.9], y_range=[-1.7, -_INPUT_Y + 0.6]
            ),
        )

    def scenery(self) -> Mapping[str, Shape]:
        """Return boxes, arrows, labels, and the packets' styles."""
        colours = [PLANT, SENSOR, NETWORK, CONTROLLER]
        shapes: dict[str, Shape] = {}
        words = ("plant x", "sensor x_s", "network", "controller x_c")
        for text, (name, x), colour in zip(words, _BOXES.items(), colours, strict=True):
            shapes[f"box/{name}"] = rr.Boxes2D(
                centers=[[x, 0.0]], half_sizes=[[_HALF_WIDE, _HALF_HIGH]], radii=0.04, colors=colour
            )
            shapes[f"box/{name}/word"] = label(text, (x, 0.28), colour)
        arrows = [_arrow(a + _HALF_WIDE, b - _HALF_WIDE, 0.0) for a, b in pairwise(_BOXES.values())]
        if self._reverse is Flow.ACKNOWLEDGEMENT:
            arrows += [
                _arrow(a - _HALF_WIDE, b + _HALF_WIDE, _REVERSE_Y)
                for a, b in ((_CONTROLLER, _NETWORK), (_NETWORK, _SENSOR))
            ]
        shapes["arrows"] = lines([line for arrow in arrows for line in arrow], STILL, 0.03)
        home = [(_CONTROLLER, -_HALF_HIGH), (_CONTROLLER, _INPUT_Y), (0.0, _INPUT_Y), (0.0, -_HALF_HIGH)]
        head = [(-0.14, -_HALF_HIGH - 0.2), (0.0, -_HALF_HIGH), (0.14, -_HALF_HIGH - 0.2)]
        inputs = [home, head]
        if self._reverse is Flow.ACTUATION:  # they cross the network
            inputs.append([(_NETWORK, -_HALF_HIGH), (_NETWORK, _INPUT_Y)])
        shapes["input"] = lines(inputs, STILL, 0.03)
        shapes["input/word"] = label("u = K x_c", (_SENSOR, _INPUT_Y + 0.4), STILL)
        shapes["lost/word"] = label("lost", (_NETWORK + 1.1, -1.0), LOST)
        shapes["forced/word"] = label("forced", (_NETWORK + _BOX_DISTANCE / 2, 1.55), FORCED)
        for entity, colour in (
            ("transmitted", SENSOR),
            ("delivered", CONTROLLER),
            ("reverse", NETWORK),
        ):
            shapes[entity] = rr.Points2D.from_fields(
                radii=_DOT_RADIUS if entity != "reverse" else 0.6 * _DOT_RADIUS,
                colors=colour,
                draw_order=5.0,
            )
        shapes["forced"] = style(FORCED, 0.1, order=6.0)
        shapes["lost"] = style(LOST, 0.1, order=6.0)
        return shapes

    def add(self, t_ns: Times, release_ns: Times, fate: NDArray[np.int64], *, reverse: bool = False) -> None:
        """Add packets (p,) that follow the previously added ones.

        Args:
            t_ns: times of their transmissions; in reverse, times of arrival at the network.
            release_ns: times at which they leave the network.
            fate: their fates in the network.
            reverse: whether they are from the controller.

        If packets are closer to each other than a dot's size, only the first is drawn.
        """
        drawn = np.zeros(len(t_ns), np.bool_)
        for i, sent_ns in enumerate(t_ns.tolist()):
            if sent_ns - self._last_ns[reverse] >= _SPACING_NS:
                drawn[i] = True
                self._last_ns[reverse] = sent_ns
        packets = np.zeros(int(drawn.sum()), _PACKET)
        packets["t_ns"], packets["fate"], packets["reverse"] = t_ns[drawn], fate[drawn], reverse
        arrived_ns = packets["t_ns"] + _LEG_NS
        out_ns = np.maximum(arrived_ns, release_ns[drawn])
        packets["out_ns"] = np.where(effective(packets["fate"]), out_ns, arrived_ns)
        self._in_flight = np.concatenate([self._in_flight, packets])

    def advance(self, until_ns: int) -> Mapping[str, Moving]:
        """Return the rows up to a time by which all packets were added."""
        first, last = self._drawn_ns // _FRAME_NS + 1, until_ns // _FRAME_NS
        if last < first:
            return {}
        self._drawn_ns = last * _FRAME_NS
        in_flight = self._in_flight
        shown_ns = np.where(effective(in_flight["fate"]), _LEG_NS, _FALL_NS)
        end_ns = in_flight["out_ns"] + shown_ns
        begin = np.maximum(-(-in_flight["t_ns"] // _FRAME_NS), first)
        end = np.minimum(-(-end_ns // _FRAME_NS), last + 1)
        counts = np.maximum(end - begin, 0)
        packet = np.repeat(np.arange(len(counts)), counts)
        frame = begin[packet] + np.arange(len(packet)) - np.repeat(np.cumsum(counts) - counts, counts)
        order = np.argsort(frame, kind="stable")
        pairs, frame = in_flight[packet[order]], frame[order]
        self._in_flight = in_flight[end_ns > self._drawn_ns]
        return self._moving(pairs, frame, first, last)

    def _moving(self, pairs: NDArray[np.void], frame: Times, first: int, last: int) -> Mapping[str, Moving]:
        """Return the rows of all entities; ``pairs`` (q,) are packets at frames, by frame."""
        now_ns = frame * _FRAME_NS
        t_ns, out_ns, reverse = pairs["t_ns"], pairs["out_ns"], pairs["reverse"]
        survives, leaves = effective(pairs["fate"]), now_ns >= out_ns
        reached = np.clip((now_ns - t_ns) / _LEG_NS, 0.0, 1.0)
        onward = (now_ns - out_ns) / _LEG_NS
        gap = _BOX_DISTANCE - 2 * _HALF_WIDE
        x = _NETWORK - _HALF_WIDE - gap * (1.0 - reached)
        # A waiting packet is drawn inside the network; a released one at its other side.
        x = np.where(reached >= 1.0, _NETWORK, x)
        x = np.where(leaves & survives, _NETWORK + _HALF_WIDE + gap * onward, x)
        fall = (now_ns - out_ns) / _FALL_NS
        y = np.where(leaves & ~survives, -_HALF_HIGH - 0.2 - 1.3 * fall, 0.0)
        forced = pairs["fate"] == Fate.FORCED
        if self._reverse is Flow.ACTUATION:
            x_ends = _NETWORK * (1 - onward), _CONTROLLER - _BOX_DISTANCE * reached
            x_back = np.where(leaves & survives, *x_ends)
            x, y = np.where(reverse, x_back, x), np.where(reverse, _INPUT_Y + 0.4 * y, y)
        else:
            x = np.where(reverse, 2 * _NETWORK - x, x)
            y = np.where(reverse & (survives | ~leaves), _REVERSE_Y, y)
        positions = upright(np.column_stack([x, y]))
        states = {
            "transmitted": ~leaves & ~reverse,
            "delivered": leaves & survives & ~forced & ~reverse,
            "reverse": (survives | ~leaves) & reverse,
            "forced": leaves & forced & ~reverse,
            "lost": leaves & ~survives,
        }
        moving: dict[str, Moving] = {}
        for entity, shown in states.items():
            shapes = np.bincount(frame[shown] - first, minlength=last - first + 1)
            before = np.concatenate([[self._shape_counts.get(entity, 0)], shapes[:-1]])
            self._shape_counts[entity] = int(shapes[-1])
            rows = (shapes > 0) | (before > 0)  # a row without shapes removes the previous ones
            if rows.any():
                t_ns = (first + np.flatnonzero(rows)) * _FRAME_NS
                moving[entity] = Moving(t_ns, _shapes(entity, positions[shown], shapes[rows]))
        return moving


_DIAMOND = 1.3 * _DOT_RADIUS * np.array([[0, -1], [1, 0], [0, 1], [-1, 0], [0, -1], [1, 0]])
_CROSS = _DOT_RADIUS * np.array([[-1, -1], [1, 1], [0, 0], [-1, 1], [1, -1]])
"""One line that passes its middle twice."""


def _shapes(entity: str, positions: Reals, counts: NDArray[np.int64]) -> Columns:
    """Return shapes at positions (q, 2); ``counts`` is the number of shapes in each row."""
    if entity in ("forced", "lost"):
        shape = _DIAMOND if entity == "forced" else _CROSS
        points = (positions[:, None, :] + shape).astype(np.float32)
        return rr.LineStrips2D.columns(strips=list(points)).partition(counts)
    return rr.Points2D.columns(positions=positions.astype(np.float32)).partition(counts)


def _arrow(start: float, end: float, y: float) -> list[list[tuple[float, float]]]:
    barb = -0.2 if end > start else 0.2
    head = [(end + barb, y + 0.14), (end, y), (end + barb, y - 0.14)]
    return [[(start, y), (end, y)], head]
