"""The pictures of plants and of the network in the recording."""

from typing import Any

import numpy as np
import pytest

from cosim.output.viewer.network_diagram import LEG_S, NetworkDiagram
from cosim.output.viewer.pictures.lane_picture import LanePicture
from cosim.output.viewer.pictures.pendulum_picture import PendulumPicture
from cosim.output.viewer.pictures.phase_picture import PhasePicture
from cosim.output.viewer.pictures.picture import WHO, Columns, Frames, Picture, panel
from cosim.output.viewer.pictures.quadrotor_picture import QuadrotorPicture
from cosim.output.viewer.pictures.tanks_picture import TanksPicture
from netem.core.packet_rows import Fate

S = 1_000_000_000
PICTURES: dict[str, tuple[Picture, int, int]] = {
    "lane": (LanePicture(3, 2, forward_mps=-12.0), 4, 0),
    "cart and pole": (PendulumPicture(0, 2, reach_m=1.0, pole_m=0.6), 4, 0),
    "pendulum": (PendulumPicture(None, 0), 2, 0),
    "cart": (PendulumPicture(0, None, reach_m=30.0), 2, 0),
    "quadrotor": (QuadrotorPicture(1.0), 12, 12),
    "tanks": (TanksPicture(), 4, 4),
    "phase": (PhasePicture(["a", "b", "c"], np.ones(3)), 3, 0),
    "one state": (PhasePicture(["a"], np.ones(1)), 1, 0),
}


def frames_of(n: int, internal: int, k: int = 7, seed: int = 0) -> Frames:
    rng = np.random.default_rng(seed)
    x, x_s, x_c = rng.normal(size=(3, k, n))
    z = rng.normal(size=(k, internal)) if internal else None
    return Frames(np.arange(k) / 60, x, x_s, x_c, z)


def arrays(columns: Columns) -> dict[str, list[Any]]:
    """Columns by the last part of their names, as lists with one entry per row."""
    return {
        str(column.component_descriptor()).rpartition(":")[2]: column.as_arrow_array().to_pylist()
        for column in columns
    }


@pytest.mark.parametrize("name", PICTURES)
def test_every_moving_shape_has_a_position_in_every_frame(name: str) -> None:
    picture, n, internal = PICTURES[name]
    shapes = picture.scenery()
    panel(picture)
    frames = frames_of(n, internal)
    frames.x_c[3:] = np.nan  # no controller
    frames.x[5] = 1e300  # a diverging run
    moving_shapes = picture.frames(frames)
    assert moving_shapes.keys() >= {entity for entity in shapes if entity in WHO}
    for entity, columns in moving_shapes.items():
        assert any(shape == entity or shape.startswith(f"{entity}/") for shape in shapes), entity
        for values in arrays(columns).values():
            assert len(values) == len(frames.t_s)
            assert np.isfinite(np.array(values, dtype=float)).all()
    # Plant and both models move, by their position or by their parts.
    for who in WHO:
        assert any(who in entity.split("/") for entity in moving_shapes), who
    assert picture.rate_hz <= 60


def rows_of(diagram: NetworkDiagram, ends_ns: list[int]) -> dict[str, dict[int, list[Any]]]:
    """The visible rows of each entity at each time."""
    by_entity: dict[str, dict[int, list[Any]]] = {}
    for until_ns in ends_ns:
        for entity, moving in diagram.advance(until_ns).items():
            ((values),) = arrays(moving.columns).values()
            assert (moving.t_ns <= until_ns).all()
            rows = by_entity.setdefault(entity, {})
            assert not rows.keys() & set(moving.t_ns.tolist())
            rows |= dict(zip(moving.t_ns.tolist(), values, strict=True))
    return by_entity


def sent(diagram: NetworkDiagram, packets: list[tuple[float, Fate]], delay_s: float = 0.0) -> NetworkDiagram:
    t_ns = np.array([round(t_s * S) for t_s, _ in packets], np.int64)
    fate = np.array([fate for _, fate in packets], np.int64)
    diagram.add(t_ns, t_ns + round(delay_s * S), fate)
    return diagram


PACKETS = [
    (0.5, Fate.DELIVERED), (0.6, Fate.DROPPED), (0.7, Fate.FORCED), (1.5, Fate.CORRUPTED),
    (1.9, Fate.DELIVERED),
]  # fmt: skip


def test_each_packet_is_drawn_with_its_fate() -> None:
    rows = rows_of(sent(NetworkDiagram(), PACKETS), [3 * S])
    steps = [round(t_s * S) for t_s in np.arange(0.013, 3.0, 0.037)]
    assert rows_of(sent(NetworkDiagram(), PACKETS), [*steps, 3 * S]) == rows  # in any batches
    assert rows.keys() == {"delivered", "forced", "lost", "transmitted"}
    for entity, count in (("delivered", 2), ("forced", 1), ("lost", 2)):
        is_shown = [bool(shapes) for _, shapes in sorted(rows[entity].items())]
        assert is_shown.count(False) == count, entity  # each packet is drawn to its end
    lost_ns = [t_ns for t_ns, shapes in rows["lost"].items() if shapes]
    assert min(lost_ns) >= (0.6 + LEG_S) * S
    # The network is at 8.8, between sensor and controller at 4.4 and 13.2.
    assert max(x for shapes in rows["delivered"].values() for x, _ in shapes) > 11
    assert max(x for shapes in rows["lost"].values() for line in shapes for x, _ in line) < 9.3
