"""Checks the invariants of a run while it goes on, in bounded memory.

Receives the batches of the spool as they arrive, and discards rows that have been checked.
"""

from collections.abc import Iterable

import numpy as np

from benchmarks.soak.legs import InTurn, Leg
from benchmarks.soak.machines import ControllerTicks, Network, PlantSteps, SensorSteps
from cosim.record.align import IdentityResidual, controller_track, initial_track, join
from cosim.record.run_record import Rows
from noack.config.resolution import loop_of, policy_of, tables_of
from noack.config.scenario import Scenario
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    NETEM_PACKET,
    NETEM_RELEASE,
    NO_SEQUENCE,
    OWNER,
    PLANT_ACTUATION,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
)
from noack.protocol.topology import LOOP_ROLES
from noack.theory.error_bounds import ErrorMonitor

_IDENTITY = 1e-9
"""Tolerance of (I1), relative to the largest entry of x_s; the same as in a run's claims."""
_TOLD = 20
_UNDER_WAY = 2
"""Number of inputs that may be sent after the plant's last step."""


class Invariants:
    """Checks a run while it goes on.

    Args:
        scenario: resolved, with the paper's trigger and nothing acknowledged.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._scenario, self._loop = scenario, loop_of(scenario)
        self._types = tables_of(scenario)
        self._pending: dict[str, list[Rows]] = {table: [] for table in self._types}
        self._early: dict[str, dict[int, Rows]] = {table: {} for table in self._types}
        self._counts = dict.fromkeys(self._types, 0)
        self._last_now_ns = dict.fromkeys(self._types, -(2**63))
        self._inputs = {role: InTurn(f"input of {role}") for role in LOOP_ROLES}
        self._measurements = Leg("measurement")
        self._into_network = Leg("update to netem")
        self._to_controller = Leg("update to controller")
        self._actuations = Leg("actuation")
        self._plant = PlantSteps(scenario)
        self._sensor = SensorSteps(scenario)
        self._ticks = ControllerTicks(scenario)
        self._network = Network(scenario.network.mansd)
        self._unjoined = np.zeros(0, self._types[SENSOR_MEASUREMENT])
        self._track = initial_track(scenario)
        self._residual = IdentityResidual(scenario)
        self._monitor = ErrorMonitor(self._loop.H, policy_of(scenario))
        self._largest = float(np.finfo(float).tiny)
        self._worst_residual = 0.0
        self._last_delivered = NO_SEQUENCE
        self._events = self._most_held = 0
        self.broken_count = 0
        self.broken: list[str] = []
        """The first few violations."""
        self.t_ns = 0
        """Time of the newest measurement."""

    @property
    def rows(self) -> dict[str, int]:
        """Number of received rows per table."""
        return dict(self._counts)

    @property
    def delivered_out_of_order(self) -> int:
        """Updates that left the network after a newer one."""
        return self._network.delivered_out_of_order

    def account(self) -> dict[str, object]:
        """Return what was checked, for the soak's result."""
        return {
            "rows": self.rows,
            "events": self._events,
            "deliveries": self._counts[CONTROLLER_DELIVERY],
            "delivered_out_of_order": self.delivered_out_of_order,
            "longest_loss_burst": self._network.longest_loss_burst,
            "identity_residual_relative": self._worst_residual,
            "most_held": self._most_held,
            "broken": self.broken_count,
            "first_broken": self.broken,
        }

    def take(self, table: str, first: int, payload: bytes) -> None:
        """Process a batch of the spool.

        A batch that was lost and sent again comes after later batches, possibly twice.
        """
        if table not in self._types:
            return  # a notice; the summary has the notices of violations
        early = self._early[table]
        early[first] = np.frombuffer(payload, self._types[table])
        while early and (first := min(early)) <= self._counts[table]:
            rows = early.pop(first)[self._counts[table] - first :]
            if len(rows):
                self._in_order(table, rows)

    def _in_order(self, table: str, rows: Rows) -> None:
        """Process the rows that follow the previously processed rows."""
        self._counts[table] += len(rows)
        now_ns = np.concatenate([[self._last_now_ns[table]], rows["now_ns"]])
        self._last_now_ns[table] = int(now_ns[-1])
        if (now_ns[1:] < now_ns[:-1]).any():
            self._break([f"{table}: now_ns runs backward"])
        self._break(self._inputs[OWNER[table]].take(rows["input"]))
        self._pending[table].append(rows)

    def advance(self, *, final: bool = False) -> None:
        """Check all complete data; at the end, everything."""
        legs = (self._measurements, self._into_network, self._to_controller, self._actuations)
        if final:  # check rows whose input never arrived without it
            self._break(
                f"{table}: row {self._counts[table]} is missing"
                for table, early in self._early.items()
                if early
            )
            for inputs in self._inputs.values():
                self._break(inputs.end())
        with np.errstate(all="ignore"):  # values that are not finite are detected and reported
            self._judge_plant()
            self._judge_network()
            self._judge_controller()
            self._judge_sensor()
            held = len(self._unjoined) + len(self._track.model_ns) + self._network.waiting
            held += sum(leg.waiting for leg in legs)
            self._join(final=final)
        self._most_held = max(self._most_held, held)
        for leg in legs:
            in_flight = _UNDER_WAY if leg is self._actuations else 0
            self._break(leg.end(in_flight) if final else leg.judge())

    def _judge_plant(self) -> None:
        if len(rows := self._take(PLANT_STEP)):
            self._break(self._plant.take(rows))
            every = self._scenario.plant.measure_every
            self._measurements.sent(rows["sequence"][rows["sequence"] % every == 0] // every)
        self._actuations.arrived(self._take(PLANT_ACTUATION)["sequence"])

    def _judge_sensor(self) -> None:
        if len(rows := self._take(SENSOR_MEASUREMENT)):
            self._break(self._sensor.take(rows))
            self._measurements.arrived(rows["sequence"])
            events = rows["event"][rows["event"] != NO_SEQUENCE]
            self._events += len(events)
            self._into_network.sent(events)
            self._unjoined = np.concatenate([self._unjoined, rows])
            self.t_ns = int(rows["t_ns"][-1])

    def _judge_network(self) -> None:
        packets, releases = self._in_turn(NETEM_PACKET), self._in_turn(NETEM_RELEASE)
        came, left, wrong = self._network.take(packets, releases)
        self._break(wrong)
        self._into_network.arrived(np.array(came, np.int64))
        self._to_controller.sent(np.array(left, np.int64))

    def _judge_controller(self) -> None:
        steps, deliveries = self._in_turn(CONTROLLER_STEP), self._in_turn(CONTROLLER_DELIVERY)
        if len(steps):
            self._break(self._ticks.take(steps))
            self._actuations.sent(steps["sequence"])
        if len(deliveries):
            sequences = deliveries["sequence"]
            self._to_controller.arrived(sequences)
            dropouts = np.diff(sequences, prepend=self._last_delivered) - 1
            self._last_delivered = int(sequences[-1])
            if (deliveries["dropouts"] != dropouts).any():
                self._break(["controller_delivery: dropouts are miscounted"])
            if dropouts.max() > self._scenario.network.mansd:
                self._break([f"controller_delivery: {dropouts.max()} dropouts in a row"])
        self._track = controller_track(self._track, steps, deliveries)

    def _join(self, *, final: bool) -> None:
        """Check (I1) at the measurements for which the controller's state is known."""
        reach_ns = int(self._track.model_ns[-1])
        if final:
            reach_ns += self._scenario.timing.controller_period_ns
        ready = int(
            np.searchsorted(self._unjoined["t_ns"], reach_ns, side="right" if final else "left")
        )
        rows, self._unjoined = self._unjoined[:ready], self._unjoined[ready:]
        if not len(rows):
            return
        joined = join(self._loop, rows, self._track, reach_ns)
        largest = np.maximum.accumulate(np.maximum(np.abs(joined.x_s).max(axis=1), self._largest))
        self._largest = float(largest[-1])
        shares = self._residual.of(rows, joined) / largest
        known = ~np.isnan(joined.x_c).any(axis=1) & ~np.isnan(shares)
        self._worst_residual = max(self._worst_residual, float(shares[known].max(initial=0.0)))
        self._tell(rows, known & ~(shares <= _IDENTITY), "(I1) does not hold")
        samples = zip(
            rows["t_ns"].tolist(), rows["x_s"] - rows["x"], rows["event"].tolist(),
            joined.received.tolist(), strict=True,
        )  # fmt: skip
        bounds = np.array([self._monitor.sample(*sample).identity for sample in samples])
        above = ~(joined.e_c_norm <= bounds + _IDENTITY * largest)
        self._tell(rows, known & above, "‖e_c‖ is above its bound from (I1)")
        keep = max(int(np.searchsorted(self._track.model_ns, rows["t_ns"][-1], "right")) - 1, 0)
        self._track = self._track.since(keep)

    def _tell(
        self, rows: Rows, where: "np.ndarray[tuple[int], np.dtype[np.bool_]]", what: str
    ) -> None:
        if where.any():
            self._break([f"{what} at t = {rows['t_ns'][np.argmax(where)]} ns"])

    def _take(self, table: str) -> Rows:
        waiting, self._pending[table] = self._pending[table], []
        return np.concatenate([np.zeros(0, self._types[table]), *waiting])

    def _in_turn(self, table: str) -> Rows:
        """Return the rows that no other row of the same process can precede."""
        rows = self._take(table)
        ready = int(np.searchsorted(rows["input"], self._inputs[OWNER[table]].next))
        if ready < len(rows):
            self._pending[table] = [rows[ready:]]
        return rows[:ready]

    def _break(self, found: Iterable[str]) -> None:
        for what in found:
            self.broken_count += 1
            if len(self.broken) < _TOLD:
                self.broken.append(what)
