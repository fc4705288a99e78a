"""The whole loop on one page: plant, sensor, network, controller, in sampled time.

It is the reference for noack's machines, written from the mathematics and the documents, with numpy
and scipy's matrix exponential alone. It is slow, and agrees with them to rounding.

    dx/dt = A x + B (u + d) + w      plant: steps of h, under a held input u
    dx_s/dt = H (x_s − x_r)          sensor: x_s ← x at each event, which transmits x
    dx_c/dt = H (x_c − x_r)          controller: x_c ← x when an update arrives
    u = K (x_c − x_r) + u_r          at each tick of the controller

H is Â + B̂K, or 0 in zero-order hold. Times are whole nanoseconds since the start. What happens by
chance is given: disturbances, noise, and the fate of each packet on the network.
"""

import heapq
import itertools
import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.linalg import expm

from tests.oracles.trigger_rules import Array, Rule, Trigger

Rows = dict[str, list[dict[str, Any]]]
NONE = -1  # stands for "no number"
PLANT, FORWARD, REVERSE, DATAGRAM, TICK = range(5)  # the order of what happens at the same time


@dataclass(frozen=True)
class Settings:
    """A loop with n states, m inputs and p outputs; matrices are per second."""

    A: Array  # plant, (n, n)
    B: Array  # (n, m)
    A_model: Array  # Â
    B_model: Array  # B̂
    K: Array  # (m, n)
    H: Array  # (n, n)
    C: Array  # measured outputs, (p, n)
    x0: Array  # x(0)
    known_x0: Array | None  # what sensor and controller know of it; None: nothing before the first update
    plant_period_ns: Fraction  # h
    measure_every: int  # steps of the plant per measurement
    controller_period_ns: Fraction
    controller_phase_ns: int  # time of the first tick
    horizon_ns: int  # neither a step nor a tick is later
    rules: Sequence[tuple[int, Rule]]  # from when on which trigger rule is in force
    references: Sequence[tuple[int, Callable[[int], Array]]]  # from when on which [x_r, u_r] of t is in force
    knows_references: bool  # from the start; else each one when it comes into force
    safe_input: Array  # before the first update
    predictions: int  # inputs in an actuation
    update_timeout_ns: float  # age from which on the newest update is not used
    timeout_input: str  # from then on: "safe" or "hold"
    watchdog: str  # "hold", "zero" or "model"
    watchdog_timeout_ns: int
    # first x̂; L, and that of the first measurement if it is another; or P, Q and R of a Kalman filter, and L
    # at each measurement, if they become constant
    observer: Mapping[str, Array] | None
    actuations_cross: bool  # whether actuations cross the network
    acknowledgement_timeout_ns: int | None  # None: nothing is acknowledged, as in the paper


@dataclass(frozen=True)
class Chance:
    """What happens by chance."""

    d: Callable[[int], Array]  # step of the plant → what is added to u until the next one, (m,)
    w: Callable[[int], Array]  # … to dx/dt, (n,)
    noise: Callable[[int], Array]  # measurement → v of y = Cx + v, (p,)
    forward: Callable[[int], Sequence[int]]  # packet to the controller → times at which it arrives
    reverse: Callable[[int], Sequence[int]]  # packet from the controller → the same


def in_force(changes: Sequence[tuple[int, Any]], t_ns: int) -> Any:
    """Return what is in force at a time."""
    return [what for since_ns, what in changes if since_ns <= t_ns][-1]


def step_ns(k: int, period_ns: Fraction) -> int:
    """Return the time of step k: the nearest whole number of nanoseconds, halves up."""
    return math.floor(k * period_ns + Fraction(1, 2))


def held_input(A: Array, B: Array, dt_ns: int | Fraction) -> tuple[Array, Array]:
    """Return Ad and Bd with x(t + dt) = Ad x(t) + Bd u, for a held input."""
    n, m = B.shape
    both = expm(np.block([[A, B], [np.zeros((m, n + m))]]) * (float(dt_ns) * 1e-9))
    return both[:n, :n], both[:n, n:]


class Model:
    """d(x − x_r)/dt = H (x − x_r), which sensor and controller follow between updates."""

    def __init__(self, s: Settings) -> None:
        self.s = s
        self.transition = lru_cache(None)(lambda dt_ns: expm(s.H * (dt_ns * 1e-9)))

    def flow(self, x: Array, from_ns: int, to_ns: int, references: Any = None) -> Array:
        """Follow the model from one time to another, through all changes of the reference."""
        references = self.s.references if references is None else references
        times = [t_ns for t_ns, _ in references if from_ns < t_ns < to_ns]
        for begin_ns, end_ns in itertools.pairwise([from_ns, *times, to_ns]):
            reference, n = in_force(references, begin_ns), len(x)
            if end_ns > begin_ns:
                deviation = x - reference(begin_ns)[:n]
                x = reference(end_ns)[:n] + self.transition(end_ns - begin_ns) @ deviation
        return x

    def input(self, point: Array, x_c: Array) -> Array:
        """Return u for [x_r, u_r]."""
        n = len(x_c)
        return self.s.K @ (x_c - point[:n]) + point[n:]


class Observer:
    """Estimates x from y and the applied inputs, with Luenberger's constant L or Kalman's."""

    def __init__(self, s: Settings, given: Mapping[str, Array]) -> None:
        self.C, self.given, self.x, self.P = s.C, given, given["x"], given.get("P")
        self.Ad, self.Bd = held_input(s.A_model, s.B_model, s.plant_period_ns)
        self.first_L, self.corrections = given.get("first_L", given.get("L")), 0

    def predict(self, u: Array) -> None:
        """Advance the estimate by a step of the plant."""
        self.x = self.Ad @ self.x + self.Bd @ u
        if self.P is not None:
            self.P = self.Ad @ self.P @ self.Ad.T + self.given["Q"]

    def correct(self, y: Array) -> Array:
        """Correct the estimate by a measurement; return it."""
        C, P = self.C, self.P
        if P is None:
            L = self.first_L
            self.first_L = self.given["L"]
        else:
            L = P @ C.T @ np.linalg.inv(C @ P @ C.T + self.given["R"])
            if (stated := self.given.get("gains")) is not None:
                L = stated[min(self.corrections, len(stated) - 1)]
            rest = np.eye(len(P)) - L @ C
            self.P = rest @ P @ rest.T + L @ self.given["R"] @ L.T
        self.corrections += 1
        self.x = self.x + L @ (y - C @ self.x)
        return self.x


class Plant:
    """Advances x by steps of h, and chooses the input that is held until the next step."""

    def __init__(self, s: Settings, chance: Chance, rows: Rows) -> None:
        self.s, self.chance, self.rows = s, chance, rows
        n, m = s.B.shape
        sources = np.hstack([s.B, np.eye(n)])
        self.over = lru_cache(None)(lambda dt_ns: held_input(s.A, sources, dt_ns))
        self.x, self.u = s.x0, np.zeros(m)
        self.recent = [self.u] * s.measure_every  # inputs since the last measurement
        self.newest = (NONE, 0, np.zeros((s.predictions, m)), np.zeros(n))  # actuation
        self.model = Model(s)

    def step(self, k: int) -> tuple[Array, Array] | None:
        """Advance to k h; return a measurement y with the recent inputs, if one is due."""
        if k > 0:
            before_ns, after_ns = (step_ns(j, self.s.plant_period_ns) for j in (k - 1, k))
            (Ad, B_and_G), m = self.over(after_ns - before_ns), len(self.u)
            pushed = B_and_G[:, :m] @ (self.u + self.chance.d(k - 1)) + B_and_G[:, m:] @ self.chance.w(k - 1)
            self.x = Ad @ self.x + pushed
            self.recent = [*self.recent[1:], self.u]
        t_ns = step_ns(k, self.s.plant_period_ns)
        self.u, entry = self.input(t_ns)
        self.rows["plant_step"].append({
            "sequence": k, "t_ns": t_ns, "x": self.x, "u": self.u, "actuation": self.newest[0],
            "entry": entry, "d": self.chance.d(k), "w": self.chance.w(k),
        })  # fmt: skip
        if k % self.s.measure_every:
            return None
        y = self.s.C @ self.x + self.chance.noise(k // self.s.measure_every)
        return y, np.concatenate(self.recent)

    def input(self, t_ns: int) -> tuple[Array, int]:
        """Return the input from t_ns on, and its number in the actuation; −1: the watchdog's."""
        _, model_ns, inputs, x_c = self.newest
        age_ns = t_ns - model_ns
        if age_ns <= self.s.watchdog_timeout_ns:
            # Input j is for j periods later, rounded down.
            entries = [j for j in range(len(inputs)) if int(j * self.s.controller_period_ns) <= age_ns]
            entry = max(entries, default=0)
            return inputs[entry], entry
        match self.s.watchdog:
            case "hold":
                return inputs[-1], NONE
            case "zero":
                return 0 * inputs[0], NONE
        # "model": the controller's input if no update has arrived since
        return inputs[0] + self.s.K @ (self.model.transition(age_ns) @ x_c - x_c), NONE

    def receive(self, number: int, model_ns: int, inputs: Array, x_c: Array) -> None:
        """Keep an actuation; it acts from the next step on."""
        self.newest = number, model_ns, inputs, x_c
        self.rows["plant_actuation"].append({
            "sequence": number, "t_ns": model_ns, "u": inputs[0], "predicted": inputs[1:].ravel(),
            "x_c": x_c,
        })  # fmt: skip


class Sensor:
    """Follows x_s, and transmits at events. Its time is that of its measurements."""

    def __init__(self, s: Settings, rows: Rows) -> None:
        self.s, self.rows, self.model = s, rows, Model(s)
        BK = s.B_model @ s.K
        (_, rule), *self.rules_to_come = s.rules
        self.trigger = Trigger(rule, s.A_model + BK, BK)
        self.observer = None if s.observer is None else Observer(s, s.observer)
        self.started = s.known_x0 is not None
        self.x_s, self.t_ns = (0 * s.x0 if s.known_x0 is None else s.known_x0), 0
        self.events = 0
        self.waiting: dict[int, Array] = {}  # updates without an acknowledgement
        self.wait_until_ns = 0
        if s.known_x0 is not None:
            self.trigger.event(0, s.known_x0 - self.x_r(0))

    def x_r(self, t_ns: int) -> Array:
        """Return x_r at a time."""
        return np.asarray(in_force(self.s.references, t_ns)(t_ns)[: len(self.s.x0)])

    def measure(self, number: int, t_ns: int, y: Array, u: Array) -> Array | None:
        """Process a measurement y, with the inputs since the last one; return x at an event."""
        trigger, resets = self.trigger, self.s.acknowledgement_timeout_ns is None
        x = y if self.observer is None else self.estimate(number, y, u)
        while self.rules_to_come and self.rules_to_come[0][0] <= t_ns:
            since_ns, rule = self.rules_to_come.pop(0)
            trigger.use(rule, since_ns)
        first, self.started = not self.started, True
        distance = x - self.x_r(t_ns)  # with which the trigger compares
        if first:
            trigger.event(t_ns, distance)
        x_s = x if first and resets else self.model.flow(self.x_s, self.t_ns, t_ns)
        e_s = x_s - x
        trigger.measured(t_ns, distance, e_s)
        left, right = trigger.sides(t_ns, distance, e_s)
        waits = bool(self.waiting) and t_ns < self.wait_until_ns
        counts, due_ns = trigger.counts(t_ns, trigger.rule), trigger.due_ns(trigger.rule)
        is_event = first or (not waits and (t_ns >= due_ns or (counts and left > right)))
        self.rows["sensor_measurement"].append({
            "sequence": number, "t_ns": t_ns, "x": x, "x_s": x_s, "y": y, "u_applied": u,
            "e_s_norm": np.linalg.norm(trigger.W @ e_s), "compared": left, "threshold": right,
            "event": self.events if is_event else NONE,
            "is_compared": counts and not (first or waits or t_ns >= due_ns), "due_ns": due_ns,
        })  # fmt: skip
        self.x_s, self.t_ns = x_s, t_ns
        if not is_event:
            return None
        if resets:  # whether or not the network will deliver the update
            self.x_s = x
            trigger.event(t_ns, distance)
            trigger.measured(t_ns, distance, 0 * x)
        else:
            self.waiting[self.events] = x
            self.wait_until_ns = t_ns + (self.s.acknowledgement_timeout_ns or 0)
        self.events += 1
        return x

    def estimate(self, number: int, y: Array, u: Array) -> Array:
        """Return x̂; before the first measurement, at time 0, the plant makes no step."""
        assert self.observer is not None
        for input_of_step in u.reshape(self.s.measure_every, -1) if number > 0 else ():
            self.observer.predict(input_of_step)
        return self.observer.correct(y)

    def acknowledge(self, number: int, event_ns: int) -> None:
        """Reset x_s to the acknowledged update, at the time of the last measurement."""
        before, x = self.x_s, self.waiting[number]
        self.x_s = self.model.flow(x, event_ns, self.t_ns)
        self.trigger.event(event_ns, x)
        self.waiting = {event: sent_x for event, sent_x in self.waiting.items() if event > number}
        self.rows["sensor_acknowledgement"].append({
            "sequence": number, "t_ns": event_ns, "model_t_ns": self.t_ns, "x_s_before": before,
            "x_s": self.x_s,
        })  # fmt: skip


class Controller:
    """Follows x_c. Its time is that of its last tick, or of a newer update."""

    def __init__(self, s: Settings, rows: Rows) -> None:
        self.s, self.rows, self.model = s, rows, Model(s)
        self.x_c, self.t_ns = (0 * s.x0 if s.known_x0 is None else s.known_x0), 0
        self.has_state, self.newest = s.known_x0 is not None, NONE
        self.update_ns, self.u = 0, 0 * s.safe_input  # the newest update's time, the last input

    def update(self, number: int, event_ns: int, x: Array) -> None:
        """Reset x_c to an update; a late one is propagated from its event to the model's time."""
        t_ns = max(self.t_ns, event_ns)
        before = self.model.flow(self.x_c, self.t_ns, t_ns)
        self.x_c, self.t_ns = self.model.flow(x, event_ns, t_ns), t_ns
        self.rows["controller_delivery"].append({
            "sequence": number, "t_ns": event_ns, "model_t_ns": t_ns, "x": x,
            "x_c_before": before, "x_c": self.x_c, "dropouts": number - self.newest - 1,
        })  # fmt: skip
        self.has_state, self.newest, self.update_ns = True, number, event_ns

    def tick(self, number: int, t_ns: int) -> tuple[int, Array, Array]:
        """Return an actuation: its model time, the inputs for it and the next ticks, and x_c."""
        self.x_c, self.t_ns = self.model.flow(self.x_c, self.t_ns, t_ns), t_ns
        x, inputs, references = self.x_c, [self.u], self.s.references
        if not self.s.knows_references:
            references = [(0, in_force(references, t_ns))]
        for k in range(self.s.predictions):
            now_ns, next_ns = (t_ns + int(j * self.s.controller_period_ns) for j in (k, k + 1))
            age_ns = now_ns - self.update_ns
            if self.has_state and age_ns < self.s.update_timeout_ns:
                inputs.append(self.model.input(in_force(references, now_ns)(now_ns), x))
            else:
                holds = self.has_state and self.s.timeout_input == "hold"
                inputs.append(inputs[-1] if holds else self.s.safe_input)
            x = self.model.flow(x, now_ns, next_ns, references)
        inputs = inputs[1:]
        self.u = inputs[0]
        self.rows["controller_step"].append({
            "sequence": number, "t_ns": t_ns, "model_t_ns": t_ns, "x_c": self.x_c, "u": inputs[0],
        })  # fmt: skip
        return t_ns, np.array(inputs), self.x_c


def run(s: Settings, chance: Chance) -> Rows:
    """Run the loop; return the rows of the record's tables, each in the order of time."""
    rows: Rows = defaultdict(list)
    plant, sensor, controller = Plant(s, chance, rows), Sensor(s, rows), Controller(s, rows)
    queue: list[tuple[Any, ...]] = []
    order, packets = itertools.count(), [0, 0]
    newest: dict[Callable[..., None], int] = defaultdict(lambda: NONE)  # by receiver

    # The event queue and the network.

    def at(t_ns: int, rank: int, action: Callable[..., None], *arguments: Any) -> None:
        heapq.heappush(queue, (t_ns, rank, next(order), action, arguments))

    def deliver(t_ns: int, receive: Callable[..., None], number: int, *content: Any) -> None:
        """Deliver a datagram; a receiver rejects one that is not newer than those it accepted."""
        if number > newest[receive]:
            newest[receive] = number
            receive(t_ns, number, *content)

    def cross(t_ns: int, direction: int, *datagram: Any) -> None:
        """Deliver a datagram across the network: at once, later, twice or never."""
        packet = packets[direction]
        packets[direction] += 1
        rows["netem_packet"].append({"flow": direction, "sequence": packet, "now_ns": t_ns})
        for arrival_ns in (chance.forward, chance.reverse)[direction](packet):
            if arrival_ns > t_ns:
                at(arrival_ns, (FORWARD, REVERSE)[direction], leave, *datagram)
            else:
                leave(t_ns, *datagram)

    def leave(t_ns: int, *datagram: Any) -> None:
        at(t_ns, DATAGRAM, deliver, *datagram)

    # What each machine does at its ticks and datagrams.

    def plant_steps(t_ns: int, k: int) -> None:
        if (measurement := plant.step(k)) is not None:
            at(t_ns, DATAGRAM, deliver, sensor_receives, k // s.measure_every, *measurement)
        if (next_ns := step_ns(k + 1, s.plant_period_ns)) <= s.horizon_ns:
            at(next_ns, PLANT, plant_steps, k + 1)

    def sensor_receives(t_ns: int, number: int, y: Array, u: Array) -> None:
        event = sensor.events
        if (x := sensor.measure(number, t_ns, y, u)) is not None:
            at(t_ns, DATAGRAM, cross, 0, controller_receives, event, t_ns, x)

    def controller_receives(t_ns: int, number: int, event_ns: int, x: Array) -> None:
        controller.update(number, event_ns, x)
        if s.acknowledgement_timeout_ns is not None:
            at(t_ns, DATAGRAM, cross, 1, acknowledgement_arrives, number, event_ns)

    def acknowledgement_arrives(t_ns: int, number: int, event_ns: int) -> None:
        sensor.acknowledge(number, event_ns)

    def controller_ticks(t_ns: int, k: int) -> None:
        route = (cross, 1) if s.actuations_cross else (deliver,)
        at(t_ns, DATAGRAM, *route, plant_receives, k, *controller.tick(k, t_ns))
        next_ns = s.controller_phase_ns + step_ns(k + 1, s.controller_period_ns)
        if next_ns <= s.horizon_ns:
            at(next_ns, TICK, controller_ticks, k + 1)

    def plant_receives(t_ns: int, number: int, *actuation: Any) -> None:
        plant.receive(number, *actuation)

    # The first ticks, and then all events in the order of time.
    at(0, PLANT, plant_steps, 0)
    if s.controller_phase_ns <= s.horizon_ns:
        at(s.controller_phase_ns, TICK, controller_ticks, 0)
    while queue:
        t_ns, _, _, action, arguments = heapq.heappop(queue)
        action(t_ns, *arguments)
    return rows
