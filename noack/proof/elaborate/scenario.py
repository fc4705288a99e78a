"""From a resolved scenario, as ``noack check --resolved`` prints it, to the loop that statements are about.

Floats are the exact binary values that noack runs with. A scenario with a key that :mod:`.keys`
refuses has no loop. A reference, or a set-point, which is a constant one, is moved to 0: see
:mod:`.reference`.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from typing import NamedTuple, Required, TypedDict

from flint import arb, arb_mat, fmpq

from netem.core.clock import NS_PER_S
from netem.core.periods import exact_ns, period_of, whole_ns
from noack.core.balls import (
    beside,
    columns_of,
    identity,
    is_zero,
    matrix,
    number,
    rows_of,
    stack,
    transpose,
    zeros,
)
from noack.core.schedule import LoopSchedule
from noack.proof.elaborate.errors import RefusedError, RejectedError
from noack.proof.elaborate.keys import Table, refusals
from noack.proof.elaborate.loop import Along, Loop, LoopObserver, Memory, Region, Rule, Times
from noack.proof.elaborate.norms import lyapunov_function, spectral_norm
from noack.proof.elaborate.reference import EnclosedSegment, Matrices, Moments, about_reference, padded
from noack.proof.elaborate.tables import read_table
from noack_equations import LinearPlants, region_of
from noack_equations import RejectedError as RejectedEquationsError

Rows = Sequence[Sequence[float]]
_WITHOUT_DELAY = ("loss", "corrupt", "blackout", "duplicate")
"""Kinds of impairments that do not change the delay of an update."""
_MOST_GAINS = 1000
_MOST_NUMBERS, _MOST_TABLES = 20_000, 1000
"""Of a matrix or a list, and tables of a kind: a loop has at most 40 states, inputs and outputs."""


class _Plants(NamedTuple):
    """The plants of a statement: entries of A and B are within half-widths of these."""

    A: Rows
    B: Rows
    half_A: Rows
    half_B: Rows


class Enclosed(NamedTuple):
    """A plant's equations, enclosed over a region."""

    plants: LinearPlants
    region: Region


def read_loop(
    resolved: Table,
    *,
    box: bool,
    ideal: bool,
    enclosed: Enclosed | None = None,
    longer: Mapping[str, fmpq] | None = None,
) -> Loop:
    """Return the loop of a resolved scenario of one loop.

    Args:
        resolved: the scenario's tables, as tomllib returns them.
        box: all plants within the uncertainty around the model; else the plant itself.
        ideal: the paper's conditions: no delay, inputs of age 0, tests at all times (at those of its
            grid for a rule that has one).
        enclosed: the equations of a plant that the scenario does not give by A and B.
        longer: some times of :class:`.loop.Times` are at least these, in s.

    Raises:
        RefusedError: a key is not covered, is missing or has a wrong value.
    """
    for refusal in refusals(resolved, has_equations=enclosed is not None):
        raise RefusedError(refusal)
    model, plant, trigger = (_table(resolved, key) for key in ("model", "plant", "trigger"))
    A, B = _matrix(model, "model.A"), _matrix(model, "model.B")
    n, m = len(A), len(B[0])
    _require_shapes(resolved, n, m)
    own = _Plants(A, B, [[0] * n] * n, [[0] * m] * n)
    if enclosed is None:
        own = own._replace(A=_matrix(plant, "plant.A"), B=_matrix(plant, "plant.B"))
    plants = _box(plant, A, B, own) if box else own
    _choice(_table(resolved, "network"), "network.initial_sync", ("first_packet", "known_state"))
    pushes = [*_disturbances(plant, matrix(plants.B), matrix(plants.half_B))]
    weight = _weight(trigger, n)
    rule, times = _rule(trigger, weight, model), _times(resolved, trigger, ideal=ideal)
    for name, least in (longer or {}).items():
        times = times._replace(**{name: max(getattr(times, name), least)})
    loop = Loop(
        A=matrix(plants.A),
        B=matrix(plants.B),
        half_A=matrix(plants.half_A),
        half_B=matrix(plants.half_B),
        model_A=matrix(A),
        model_B=matrix(B),
        gain=matrix(_matrix(model, "model.gain")),
        weight=weight,
        holds=_choice(resolved, "mode", ("model", "zoh")) == "zoh",
        rule=rule,
        pushes=arb_mat(n, len(pushes), [column[i] for i in range(n) for column in pushes]),
        sizes=(arb(1),) * len(pushes),
        noise=_noise(resolved, n),
        observer=_observer(resolved, plants, ideal=ideal),
        outputs=_outputs(resolved, n),
        losses=most_losses(_table(resolved, "network")),
        times=times,
        **_start(resolved, plants),
    )
    if enclosed is not None and loop.loads:
        raise RefusedError("model.load_states: not covered on a region")
    if "reference" in _table(resolved, "controller"):
        loop = _about_reference(loop, resolved)
    return loop if enclosed is None else _with_equations(loop, resolved, enclosed)


def _about_reference(loop: Loop, resolved: Table) -> Loop:
    """Return a loop about its reference, x_r(t), which is 0 in these coordinates."""
    n, m, rule = loop.n, loop.B.ncols(), loop.rule
    segments = _segments(_table(resolved, "controller"), n - loop.loads, m)
    matrices = Matrices(loop.A, loop.B, loop.half_A, loop.half_B, loop.H, loop.gain)
    moments = Moments(
        loop.times.from_tick, loop.times.start, fmpq(*_real(resolved, "horizon_s").as_integer_ratio())
    )
    about = about_reference(
        [padded(segment, n - loop.loads, loop.loads) for segment in segments],
        matrices,
        moments,
        _error_gain(loop),
    )
    if not about.offset.is_finite():
        raise RefusedError(
            "controller.reference: the models about it are not stable, and its pieces do not join exactly"
        )
    compares_x = rule.negative.nrows() or rule.memory is not None
    if about.offset != 0 and (compares_x or not is_zero(columns_of(rule.positive, range(n)))):
        raise RefusedError(
            "trigger.policy: it compares with x, which jumps by rounding where two pieces join"
        )
    columns = [(size * columns_of(loop.B, [j])).entries() for j, size in enumerate(about.input)]
    columns += [(size * columns_of(identity(n), [i])).entries() for i, size in enumerate(about.state)]
    columns = [kept for column in columns for kept in _nonzero(column)]
    before = about.before_input
    if loop.push_before_input is not None:
        before += loop.push_before_input
    added = arb_mat(n, len(columns), [column[i] for i in range(n) for column in columns])
    return loop._replace(
        start=loop.start - about.start,
        pushes=beside(loop.pushes, added) if columns else loop.pushes,
        sizes=(*loop.sizes, *[arb(1)] * len(columns)),
        push_before_input=before if loop.push_before_input is not None or not is_zero(before) else None,
        observer=None if loop.observer is None else loop.observer._replace(unfelt=len(columns)),
        until=None if len(segments) == 1 and segments[0].is_constant else about.until,
        offset=about.offset,
    )


def _error_gain(loop: Loop) -> arb | None:
    """Return a bound of ‖e^{Hτ}‖ over all τ ≥ 0; None if H is not stable."""
    if is_zero(loop.H):
        return arb(1)
    P = lyapunov_function(loop.H, identity(loop.n))
    return None if P is None else (spectral_norm(P) * spectral_norm(P.inv())).sqrt()


def _segments(controller: Table, n: int, m: int) -> list[EnclosedSegment]:
    """Return the segments of a reference of n states and m inputs."""
    found: list[EnclosedSegment] = []
    for entry in _tables(controller, "controller.reference"):
        _choice(entry, "controller.reference.kind", ("segment",))
        hz = [number(f) for f in _row(entry, "controller.reference.hz")] if "hz" in entry else []
        rows = {
            key: _wide(entry, f"controller.reference.{key}", width) for key, width in (("x", n), ("u", m))
        }
        if len(rows["x"]) != len(rows["u"]):
            raise RefusedError("controller.reference: x and u do not have as many coefficients")
        waves = {}
        for wave in ("sines", "cosines"):
            names = ((f"x_{wave}", n), (f"u_{wave}", m))
            waves[wave] = [
                _wide(entry, f"controller.reference.{key}", width) if hz else [] for key, width in names
            ]
            if any(len(each) != len(hz) for each in waves[wave]):
                raise RefusedError(f"controller.reference: not {wave} for each frequency")
        begin = _seconds(round(_real(entry, "controller.reference.from_s") * NS_PER_S))
        if begin <= found[-1].begin if found else begin != 0:
            raise RefusedError(
                "controller.reference.from_s: the first segment begins at 0, each other one later"
            )
        sides = (
            _by_columns(x, u, n + m) for x, u in ((rows["x"], rows["u"]), waves["sines"], waves["cosines"])
        )
        polynomial, sines, cosines = sides
        found.append(EnclosedSegment(begin, polynomial, hz, sines, cosines))
    if not found:
        raise RefusedError("controller.reference: no segment")
    return found


def _wide(table: Table, name: str, width: int) -> Rows:
    rows = _matrix(table, name)
    if len(rows[0]) != width:
        raise RefusedError(f"{name}: not {width} numbers in a row")
    return rows


def _by_columns(x: Rows, u: Rows, height: int) -> arb_mat:
    """Return a column of n + m numbers for each row of x and u."""
    columns = [[*of_x, *of_u] for of_x, of_u in zip(x, u, strict=True)]
    return arb_mat(height, len(columns), [number(column[i]) for i in range(height) for column in columns])


def read_region(document: Table, n: int, m: int) -> Region:
    """Return the region of a document."""
    table, found = read_table(document, "region"), []
    for key, count in (("x", n), ("u", m)):
        sizes = table.get(key)
        if not isinstance(sizes, list) or len(sizes) != count:
            raise RejectedError(f"region: not {count} sizes of {key}")
        found.append(sizes)
    try:
        return region_of(found[0], found[1])
    except RejectedEquationsError as error:
        raise RejectedError(str(error)) from None


def _with_equations(loop: Loop, resolved: Table, enclosed: Enclosed) -> Loop:
    """Return the loop with a plant's equations; x and the disturbed input have to stay in their region."""
    plants, region = enclosed
    n, m = loop.n, plants.B.ncols()
    if loop.observer is not None:
        raise RefusedError("observer: not covered with a plant's equations")
    if "reference" in _optional_table(resolved, "controller"):
        raise RefusedError("controller.reference: not covered with a plant's equations")
    plant, nothing = _table(resolved, "plant"), Along(arb_mat(1, n + m), arb(0))
    disturbances, room = list(_disturbances(plant, plants.B, plants.half_B)), _input_room(plant, m)
    is_moved = any(each > 0 for each in room)
    along = [
        nothing if is_moved and not is_zero(columns_of(a.row, range(n, n + m))) else a for a in plants.along
    ]
    columns = [columns_of(plants.pushes, [k]).entries() for k in range(plants.pushes.ncols())]
    columns += disturbances
    limits = tuple(None if s is None else s - each for s, each in zip(region.u, room, strict=True))
    return loop._replace(
        A=plants.A,
        B=plants.B,
        half_A=plants.half_A,
        half_B=plants.half_B,
        pushes=arb_mat(n, len(columns), [column[i] for i in range(n) for column in columns]),
        sizes=(arb(1),) * len(columns),
        along=(*along, *[nothing] * len(disturbances)),
        region=region._replace(u=limits),
    )


def _input_room(plant: Table, m: int) -> list[arb]:
    """Return by how much disturbances move each input at most."""
    room = [arb(0)] * m
    for entry in _tables(plant, "plant.disturbances"):
        if entry.get("at") == "input":
            name = "bound" if entry.get("kind") == "uniform" else "amplitude"
            values = _row(entry, f"plant.disturbances.{name}")
            room = [each + abs(number(value)) for each, value in zip(room, values, strict=True)]
    return room


class _StartTable(TypedDict, total=False):
    """Where a loop starts."""

    start: Required[arb_mat]
    loads: int
    push_before_input: arb_mat


def _start(resolved: Table, plants: _Plants) -> _StartTable:
    """Return where the loop starts, in coordinates in which its loads are 0.

    With u = Kx + K_d d and a constant d the closed loop rests at Πd, where (A + BK)Π + E + BK_d = 0. There
    the plant, both models and the observer rest together, at (Πd, d). So the loop about this point is the
    same loop with the load 0, but for the input: until the first one acts it is 0, and so −(KΠ + K_d)d from
    its value at rest.
    """
    model, plant = _table(resolved, "model"), _table(resolved, "plant")
    x_0 = matrix([[value] for value in _row(plant, "plant.initial_state")])
    k = _whole(model, "model.load_states") if "load_states" in model else 0
    if not k:
        return {"start": x_0}
    _require_unknown_start(resolved, "loads")  # they are not known
    n = len(plants.A) - k
    if n < 1:
        raise RefusedError("model.load_states: not fewer than states")
    of_model = (_matrix(model, "model.A"), _matrix(model, "model.B"))
    matrices = (plants.A, plants.B, plants.half_A, plants.half_B, *of_model)
    if any(any(row) for M in matrices for row in M[n:]):
        raise RefusedError("model.load_states: the last states are not constant")
    pushes = _disturbances(plant, matrix(plants.B), matrix(plants.half_B))
    if not all(entry == 0 for column in pushes for entry in column[n:]):
        raise RefusedError("plant.disturbances: the load changes, and its statement is for a constant one")
    if any(map(any, (*plants.half_A, *plants.half_B))):
        raise RefusedError("model.load_states: the statement is for one plant, not for all in a box")
    if resolved.get("mode") != "zoh" and of_model != (plants.A, plants.B):
        raise RefusedError("model.load_states: where the plant rests, a model that differs from it does not")
    A, B, K = matrix(plants.A), matrix(plants.B), matrix(_matrix(model, "model.gain"))
    closed, own = A + B * K, range(n)
    load = rows_of(x_0, range(n, n + k))
    effect = columns_of(rows_of(closed, own), range(n, n + k)) * load
    rest = stack([-1 * columns_of(rows_of(closed, own), own).inv() * effect, load])
    start = stack([rows_of(x_0 - rest, own), zeros(k, 1)])
    return {"loads": k, "push_before_input": -1 * B * (K * rest), "start": start}


def _box(plant: Table, A: Rows, B: Rows, own: _Plants) -> _Plants:
    """Return the plants within the uncertainty around the model."""
    half_A = _matrix(plant, "plant.uncertainty_A") if "uncertainty_A" in plant else own.half_A
    half_B = _matrix(plant, "plant.uncertainty_B") if "uncertainty_B" in plant else own.half_B
    return _Plants(A, B, half_A, half_B)


def _require_shapes(resolved: Table, n: int, m: int) -> None:
    model, plant = _table(resolved, "model"), _table(resolved, "plant")
    shapes = {"model.A": (n, n), "model.B": (n, m), "model.gain": (m, n), "plant.A": (n, n)}
    shapes |= {"plant.B": (n, m), "plant.uncertainty_A": (n, n), "plant.uncertainty_B": (n, m)}
    for name, (height, width) in shapes.items():
        table = model if name.startswith("model.") else plant
        if name.startswith("plant.") and name.partition(".")[2] not in table:
            continue
        rows = _matrix(table, name)
        if len(rows) != height or len(rows[0]) != width:
            raise RefusedError(f"{name}: not {height} x {width}")
        if name.startswith("plant.uncertainty") and any(half < 0 for row in rows for half in row):
            raise RefusedError(f"{name}: below 0")
    if len(_row(plant, "plant.initial_state")) != n:
        raise RefusedError(f"plant.initial_state: not {n} numbers")
    measured = _optional_table(plant, "measurement").get("C")
    if "observer" not in resolved and measured not in (
        None,
        [[int(i == j) for j in range(n)] for i in range(n)],
    ):
        raise RefusedError("plant.measurement.C: the sensor does not measure the state")


def _outputs(resolved: Table, n: int) -> arb_mat:
    """Return the rows of the outputs, (p, n); (0, n): they are the states."""
    rows = [_row(entry, "outputs.row") for entry in _tables(resolved, "outputs")]
    if any(len(row) != n for row in rows):
        raise RefusedError(f"outputs.row: not {n} numbers")
    return matrix(rows) if rows else zeros(0, n)


def output_names(resolved: Table) -> list[str]:
    """Return the names of a resolved scenario's outputs, by default of the states; empty: there are none."""
    entries, model = _tables(resolved, "outputs"), _table(resolved, "model")
    names = [entry.get("name") for entry in entries] or model.get("state_names", [])
    if not isinstance(names, list) or not all(isinstance(name, str) and name.isprintable() for name in names):
        raise RefusedError("outputs.name: not a printable name")
    if names and not entries and len(names) != (n := len(_matrix(model, "model.A"))):
        raise RefusedError(f"model.state_names: not {n} names")
    return names


def most_losses(network: Table, name: str = "network") -> int:
    """Return the most consecutive losses that the guarantee of a direction of the network allows."""
    windows = [_window(e) for e in _tables(network, f"{name}.constraints") if e.get("kind") == "at_most"]
    limits = [limit for limit, window in windows if limit < window]
    if "mansd" in network or not limits:
        limits.append(_whole(network, f"{name}.mansd"))
    return min(limits)


def _window(constraint: Table) -> tuple[int, int]:
    """Return the most losses of a rule, and in how many successive updates."""
    losses, window = (_whole(constraint, f"network.constraints.{key}") for key in ("losses", "window"))
    if window < 1:
        raise RefusedError("network.constraints.window: below 1")
    return losses, window


def _times(resolved: Table, trigger: Table, *, ideal: bool) -> Times:
    """Return the times; a rule with a grid is tested at its points, and otherwise at measurements."""
    plant, zero, due = _table(resolved, "plant"), fmpq(0), _due_ns(trigger)
    times = Times(zero, zero, zero, zero, zero, *map(_seconds, due))
    if not ideal:
        schedule = read_schedule(resolved)
        times = Times(*map(_seconds, schedule.bounds))
        if due[1]:
            (first, _), (_, last) = map(schedule.between_events_ns, due)
            times = times._replace(least_period=_seconds(first), period=_seconds(last))
        _require_watchdog(_optional_table(plant, "watchdog"), schedule)
        _require_stated_delay(resolved)
    if due[1]:
        return times
    outer, inner = _combined(trigger)[:-1], _combined(trigger)[-1]
    if inner.get("policy") == "quadratic":
        grid_ns = _interval_ns(inner, "trigger.period_s")
        if grid_ns % read_schedule(resolved).sample.exact:
            raise RefusedError("trigger.period_s: not a multiple of the time between measurements")
        grid = _seconds(grid_ns)
        # With a deadline an event may come between two points of the grid.
        has_deadline = any(rule.get("policy") == "deadline" for rule in outer)
        least = times.least_sampling if has_deadline else grid
        times = times._replace(sampling=grid, least_sampling=least)
    intervals, sampling = _intervals(trigger), times.sampling
    is_exact = sampling == times.least_sampling
    if inner.get("policy") == "dynamic" and not (is_exact and sampling > 0):
        raise RefusedError(
            'trigger.policy = "dynamic": not covered without tests that are an exact time apart'
        )
    if intervals.dwell:
        if not is_exact:
            raise RefusedError("trigger.interval_s: not covered with tests that are not an exact time apart")
        dwell = _seconds(intervals.dwell)
        times = times._replace(dwell=(dwell / sampling).ceil() * sampling if sampling > 0 else dwell)
    if intervals.longest and not (outer and inner.get("heartbeat")):
        first_due, longest = map(_seconds, intervals[1:])
        if not ideal:
            schedule = read_schedule(resolved)
            first_due = _seconds(schedule.between_events_ns(intervals.shortest)[0])
            longest = _seconds(schedule.between_events_ns(intervals.longest)[1])
        elif outer:
            longest += sampling
        times = times._replace(due=first_due, longest=longest)
    return times


def _combined(trigger: Table) -> list[Table]:
    """Return a rule, and the rules that it contains, from the outside to the inside."""
    found = [trigger]
    while found[-1].get("policy") in ("deadline", "dwell"):
        found.append(_table(found[-1], "rule"))
    return found


class _Intervals(NamedTuple):
    """The times after an event, in ns, that a trigger names."""

    dwell: int = 0
    """The comparison does not count before this time."""
    shortest: int = 0
    longest: int = 0
    """The next event is due at some time between both, whatever is compared; 0: none is due."""


def _intervals(trigger: Table) -> _Intervals:
    """Return the times that a trigger names; see noack.trigger_policies for what they mean together."""
    *outer, base = _combined(trigger)
    found, policy = _Intervals(), base.get("policy")
    if policy == "periodic":
        period_ns = _interval_ns(base, "trigger.period_s")
        found = _Intervals(0, period_ns, period_ns)
    elif policy == "self_triggered":
        ends = (_interval_ns(base, f"trigger.{key}_s") for key in ("shortest", "longest"))
        found = _Intervals(0, *ends)
    elif policy == "quadratic":
        heartbeat_ns = _whole(base, "trigger.heartbeat") * _interval_ns(base, "trigger.period_s")
        found = _Intervals(0, heartbeat_ns, heartbeat_ns)
    for rule in reversed(outer):
        interval_ns = _interval_ns(rule, "trigger.interval_s")
        if rule.get("policy") == "dwell":
            due = (max(ns, interval_ns) if found.longest else 0 for ns in found[1:])
            found = _Intervals(max(found.dwell, interval_ns), *due)
        else:
            due = (min(ns, interval_ns) if found.longest else interval_ns for ns in found[1:])
            found = _Intervals(found.dwell, *due)
    return found


def _interval_ns(trigger: Table, name: str) -> int:
    interval_ns = whole_ns(_real(trigger, name))
    if not interval_ns:
        raise RefusedError(f"{name}: below 1 ns")
    return interval_ns


def _due_ns(trigger: Table) -> tuple[int, int]:
    """Return after which times the next event of a rule is due that does not depend on a comparison, in ns.

    It is due at some time between both. They are 0 for rules that depend on one. With a deadline, rules of
    which a comparison says little may have an event at any test up to it.
    """
    times, policy = _intervals(trigger), _combined(trigger)[-1].get("policy")
    if policy in ("periodic", "self_triggered"):
        return times.shortest, times.longest
    if times.longest and policy in ("send_on_area", "lyapunov", "dynamic"):
        return min(max(times.dwell, 1), times.longest), times.longest
    is_due_first = 0 < times.longest <= times.dwell
    return (times.longest, times.longest) if is_due_first else (0, 0)


def read_schedule(resolved: Table) -> LoopSchedule:
    """Return the schedule of a resolved scenario."""
    plant, controller, certificate = (_table(resolved, key) for key in ("plant", "controller", "certificate"))
    name = "controller.predictions"
    predictions = _whole(controller, name) if "predictions" in controller else 1
    if predictions < 1:
        raise RefusedError(f"{name}: below 1")
    step, tick = (
        period_of(_rate(table, f"{name}.rate_hz"))
        for table, name in ((plant, "plant"), (controller, "controller"))
    )
    gap_ns = 0
    if "actuation" in (network := _table(resolved, "network")):
        direction, name = _table(network, "actuation"), "network.actuation"
        delay_ns = math.ceil(_constant_delay_ns(direction, name))
        gap_ns = most_losses(direction, name) * tick.longest_ns + delay_ns
    return LoopSchedule(
        step,
        max(_whole(plant, "plant.measure_every"), 1),
        tick,
        _real(controller, "controller.phase"),
        _whole(certificate, "certificate.late_periods"),
        _real(certificate, "certificate.network_delay_s") if "network_delay_s" in certificate else 0.0,
        gap_ns,
        predictions,
    )


def _seconds(time_ns: int) -> fmpq:
    return fmpq(time_ns, NS_PER_S)


def _require_stated_delay(resolved: Table) -> None:
    """Require that the delay of updates, where it is constant, is within the stated one."""
    try:
        delay_ns = _constant_delay_ns(_table(resolved, "network"), "network")
    except RefusedError:
        return  # it varies: the run checks it
    stated_s = _real(_table(resolved, "certificate"), "certificate.network_delay_s") if delay_ns else 0.0
    if delay_ns > stated_s * NS_PER_S + 1:
        raise RefusedError("certificate.network_delay_s: the network delays each update by more")


def _constant_delay_ns(direction: Table, name: str) -> Fraction:
    """Return the delay in a direction of the network; raise RefusedError if it may vary."""
    total = Fraction(0)
    for entry in _tables(direction, f"{name}.impairments"):
        kind = entry.get("kind")
        if kind == "delay" and not (entry.get("jitter_s") or entry.get("samples_s") or entry.get("file")):
            total += exact_ns(_real(entry, f"{name}.impairments.delay_s"))
        elif kind not in _WITHOUT_DELAY:
            raise RefusedError(f"{name}.impairments: {kind}: the delay is not constant")
    return total


_OF_REST = ("reference", "setpoint", "safe_input", "update_timeout_s", "timeout_input")
"""Settings of the controller that do not change by what the difference of two runs is multiplied."""


def read_linear_loop(resolved: Table) -> Loop:
    """Return the matrices and the most losses of a resolved scenario's loop, whatever its rule compares.

    Raises:
        RefusedError: a key is not covered, is missing or has a wrong value, or something disturbs the loop.
    """
    controller, plant = _table(resolved, "controller"), _table(resolved, "plant")
    if "actuation" in _table(resolved, "network") or controller.get("predictions", 1) != 1:
        raise RefusedError("network.actuation: the growth is of a loop whose inputs do not cross the network")
    without_rest = {key: value for key, value in controller.items() if key not in _OF_REST}
    any_rule = {"policy": "periodic", "period_s": 1.0}
    on_time = {**_table(resolved, "certificate"), "late_periods": 0, "network_delay_s": 0.0}
    resolved = {**resolved, "controller": without_rest, "trigger": any_rule, "certificate": on_time}
    loop = read_loop(resolved, box=False, ideal=True)
    if loop.observer is not None or loop.noise.ncols() or loop.sizes:
        raise RefusedError("the growth is of a loop without observer, noise and disturbances")
    _require_watchdog(_optional_table(plant, "watchdog"), read_schedule(resolved))
    return loop


def _require_watchdog(watchdog: Table, schedule: LoopSchedule) -> None:
    """Require that the plant's watchdog does not replace inputs as old as they may be.

    With the policy "hold" it applies the last one of the newest tick, which may have to wait for its time.
    """
    holds = watchdog.get("policy", "hold") == "hold"
    if holds and not schedule.last_prediction_ns:
        return
    timeout_s = _real(watchdog, "plant.watchdog.timeout_s")
    oldest_ns = schedule.last_prediction_ns if holds else schedule.oldest_inputs_ns
    if whole_ns(timeout_s) < oldest_ns:
        raise RefusedError(
            f"plant.watchdog.timeout_s = {timeout_s:g}: the watchdog may replace an input, "
            f"which may be {oldest_ns / NS_PER_S:g} s old"
        )


# The trigger.


def _weight(trigger: Table, n: int) -> arb_mat:
    """Return W; that of a rule that contains another one is that of the inner rule."""
    trigger = _combined(trigger)[-1]
    if "weight" not in trigger:
        return identity(n)
    rows = _matrix(trigger, "trigger.weight")
    if len(rows) != n or len(rows[0]) != n:
        raise RefusedError(f"trigger.weight: not {n} x {n}")
    return matrix(rows)


def _rule(trigger: Table, weight: arb_mat, model: Table) -> Rule:
    """Return the rule of a trigger; one whose events do not depend on its comparison has none."""
    if _due_ns(trigger)[1]:
        nothing = zeros(0, 2 * weight.nrows())
        return Rule(nothing, nothing, arb(0), arb(0), arb(0))
    outer, rule = _combined(trigger)[:-1], _compared(_combined(trigger)[-1], weight, model)
    if rule.integrates and outer:
        raise RefusedError('trigger.policy = "send_on_area": not covered with a dwell time')
    return rule._replace(always=_intervals(trigger).longest > 0)


def _compared(trigger: Table, weight: arb_mat, model: Table) -> Rule:
    """Return the comparison of a rule, in which W e_s is compared, or a quadratic form."""
    n, policy = weight.nrows(), trigger.get("policy")
    errors, nothing = beside(zeros(n, n), weight), zeros(0, 2 * n)
    rule = Rule(errors, nothing, arb(0), arb(0), arb(0))
    if policy == "decaying":
        names = ("trigger.beta", "trigger.alpha_per_s", "trigger.floor")
        level, rate, floor = (number(_real(trigger, name)) for name in names)
        return rule._replace(level=level, rate=rate, floor=floor)
    if policy == "absolute":
        return rule._replace(floor=number(_real(trigger, "trigger.delta")))
    if policy in ("relative", "mixed"):
        floor = number(_real(trigger, "trigger.epsilon")) if policy == "mixed" else arb(0)
        states = beside(number(_real(trigger, "trigger.sigma")) * weight, zeros(n, n))
        return rule._replace(negative=states, floor=floor)
    if policy == "quadratic":
        positive, negative = _squares(_symmetric(trigger, "trigger.Q", 2 * n))
        floor = number(_real(trigger, "trigger.epsilon")).sqrt()
        return rule._replace(positive=positive, negative=negative, floor=floor)
    if policy == "dynamic":
        return _dynamic(trigger, n, model)
    if policy == "send_on_area":
        return rule._replace(floor=number(_real(trigger, "trigger.delta_s")), integrates=True)
    end = ": not covered without a deadline" if policy == "lyapunov" else ": not covered"
    raise RefusedError(f"trigger.policy = {policy!r}{end}")


def _dynamic(trigger: Table, n: int, model: Table) -> Rule:
    """Return Girard's rule: η + θw < 0 with w = σ xᵀQx − 2 xᵀPBK e_s and dη/dt = −λη + w.

    P is any symmetric matrix that the scenario states.
    """
    B = matrix(_matrix(model, "model.B"))
    Q = _symmetric(trigger, "trigger.Q", n) if "Q" in trigger else identity(n)
    P = _symmetric(trigger, "trigger.P", n)
    keys = ("sigma", "theta_s", "decay_per_s", "eta_0")
    sigma, theta, decay, start = (number(_real(trigger, f"trigger.{key}")) for key in keys)
    w = _blocks(sigma * Q, -1 * (P * B))
    zero = arb(0)
    return Rule(*_squares(-1 * theta * w), zero, zero, zero, memory=Memory(decay, w, start), of_input=True)


def _blocks(first: arb_mat, cross: arb_mat) -> arb_mat:
    """Return the symmetric matrix of two blocks above, and 0 below on the right; without radii."""
    whole = stack([beside(first, cross), beside(transpose(cross), zeros(cross.ncols(), cross.ncols()))])
    return arb_mat(whole.nrows(), whole.ncols(), [entry.mid() for entry in whole.entries()])


def _squares(Q: arb_mat) -> tuple[arb_mat, arb_mat]:
    """Return P and N with ‖Pz‖² − ‖Nz‖² = zᵀQz of a symmetric Q without radii.

    2ab is ((a + b)² − (a − b)²)/2.
    """
    size = Q.nrows()
    P, N = [zeros(0, size)], [zeros(0, size)]
    for i in range(size):
        for j in range(i + 1):
            value = Q[i, j]
            own, others = (P, N) if value > 0 else (N, P)
            first, second = (rows_of(identity(size), [k]) for k in (i, j))
            if i == j and value != 0:
                own.append(abs(value).sqrt() * first)
            elif value != 0:
                root = (abs(value) / 2).sqrt()
                own.append(root * (first + second))
                others.append(root * (first - second))
    return _stacked(P), _stacked(N)


def _stacked(blocks: Sequence[arb_mat]) -> arb_mat:
    return stack(blocks) if len(blocks) > 1 else blocks[0]


# Disturbances and set-points.


def _disturbances(plant: Table, B: arb_mat, half_B: arb_mat) -> Iterator[list[arb]]:
    """Yield columns: bounded disturbances add their multiples with factors from −1 to 1 to ẋ."""
    n, m = B.nrows(), B.ncols()
    for entry in _tables(plant, "plant.disturbances"):
        at_input = _choice(entry, "plant.disturbances.at", ("input", "state")) == "input"
        kind = _choice(entry, "plant.disturbances.kind", ("sine", "step", "uniform"))
        each_alone = kind == "uniform"
        values = _row(entry, f"plant.disturbances.{'bound' if each_alone else 'amplitude'}")
        if len(values) != (m if at_input else n):
            raise RefusedError("plant.disturbances: not one number per input or state")
        signals = [[0.0] * k + [v] + [0.0] * (len(values) - k - 1) for k, v in enumerate(values)]
        for signal in signals if each_alone else [values]:
            yield from _nonzero(_product(B, signal) if at_input else [number(v) for v in signal])
            if at_input:
                sizes = _product(half_B, [abs(v) for v in signal])
                for i, size in enumerate(sizes):  # B of the plants is not known
                    yield from _nonzero([size if k == i else arb(0) for k in range(n)])


def _noise(resolved: Table, n: int) -> arb_mat:
    """Return the columns of the noise of measurements, of all outputs with an observer."""
    measurement = _optional_table(_table(resolved, "plant"), "measurement")
    p, name = len(_measured(resolved, n)), "plant.measurement.noise_bound"
    sizes = _row(measurement, name) if "noise_bound" in measurement else [0.0] * p
    if len(sizes) != p or min(sizes) < 0:
        raise RefusedError(f"{name}: not {p} numbers of at least 0")
    if any(sizes):
        _require_unknown_start(resolved, "noise")
    bounds = matrix([[size * (i == k) for k in range(p)] for i, size in enumerate(sizes)])
    return columns_of(bounds, [i for i, size in enumerate(sizes) if size > 0])


def _measured(resolved: Table, n: int) -> Rows:
    """Return the rows of C in y = Cx + v."""
    measurement = _optional_table(_table(resolved, "plant"), "measurement")
    every = [[int(i == j) for j in range(n)] for i in range(n)]
    return _wide(measurement, "plant.measurement.C", n) if "C" in measurement else every


def _observer(resolved: Table, plants: _Plants, *, ideal: bool) -> LoopObserver | None:
    """Return the observer in the sensor, if there is one, of a plant that its matrices describe exactly."""
    if "observer" not in resolved:
        return None
    _require_unknown_start(resolved, "an observer")
    model, plant, observer = (_table(resolved, key) for key in ("model", "plant", "observer"))
    for key, rows, half in (("A", plants.A, plants.half_A), ("B", plants.B, plants.half_B)):
        if rows != model[key] or any(map(any, half)):
            raise RefusedError(f"plant.{key}: with an observer only plants with model.{key} are covered")
    n, schedule = len(plants.A), read_schedule(resolved)
    if not schedule.is_whole:
        raise RefusedError("plant.rate_hz, controller.rate_hz: with an observer the periods are whole ns")
    if ideal:
        raise RefusedError("observer: ideal conditions, with tests at all times, are not covered")
    x_0, rows = _row(plant, "plant.initial_state"), _measured(resolved, n)
    C = matrix(rows)
    estimate = _row(observer, "observer.initial_estimate") if "initial_estimate" in observer else [0.0] * n
    if len(estimate) != n:
        raise RefusedError(f"observer.initial_estimate: not {n} numbers")
    start = matrix([[value] for value in estimate]) - matrix([[value] for value in x_0])
    gains = tuple(matrix(rows) for rows in _gains(observer))
    if any((gain.nrows(), gain.ncols()) != (n, C.nrows()) for gain in gains):
        raise RefusedError("observer: a gain has not a row for each state, and a column for each output")
    return LoopObserver(gains, C, start, _seconds(schedule.sample.longest_ns))


def _gains(observer: Table) -> list[Rows]:
    """Return the observer's gains at the first measurements; the last one is that of all later ones."""
    if _choice(observer, "observer.kind", ("luenberger", "kalman")) == "luenberger":
        names = ["first_gain", "gain"] if "first_gain" in observer else ["gain"]
        return [_matrix(observer, f"observer.{name}") for name in names]
    if "gains" not in observer:
        raise RefusedError(
            "observer.gains: missing; noack check --resolved states them if they become constant"
        )
    gains = observer["gains"]
    if not isinstance(gains, list) or not 0 < len(gains) <= _MOST_GAINS:
        raise RefusedError(f"observer.gains: not from 1 to {_MOST_GAINS} matrices")
    return [_matrix({"gains": gain}, "observer.gains") for gain in gains]


def _require_unknown_start(resolved: Table, what: str) -> None:
    """Require that the first update is sent at t = 0: before it x is not known to sensor and controller."""
    if _value(_table(resolved, "network"), "network.initial_sync") == "known_state":
        raise RefusedError(f'network.initial_sync = "known_state": not covered with {what}')


def _product(M: arb_mat, v: Sequence[float]) -> list[arb]:
    return (M * matrix([[value] for value in v])).entries()


def _nonzero(column: list[arb]) -> Iterator[list[arb]]:
    if not all(entry == 0 for entry in column):  # also a ball around 0
        yield column


# Reading tables. A name has the key's place in the scenario: ``plant.rate_hz``.


def _table(table: Table, key: str) -> Table:
    value = table.get(key)
    if not isinstance(value, Mapping):
        raise RefusedError(f"{key}: the table is missing")
    return value


def _optional_table(table: Table, key: str) -> Table:
    return _table(table, key) if key in table else {}


def _value(table: Table, name: str) -> object:
    key = name.rpartition(".")[2]
    if key not in table:
        raise RefusedError(f"{name}: missing")
    return table[key]


def _choice(table: Table, name: str, choices: Sequence[str]) -> str:
    value = _value(table, name)
    if value not in choices:
        raise RefusedError(f"{name}: not one of {', '.join(choices)}")
    return str(value)


def _tables(table: Table, name: str) -> Sequence[Table]:
    value = table.get(name.rpartition(".")[2], [])
    if not isinstance(value, list) or not all(isinstance(entry, Mapping) for entry in value):
        raise RefusedError(f"{name}: not a list of tables")
    if len(value) > _MOST_TABLES:
        raise RefusedError(f"{name}: more than {_MOST_TABLES:,} tables")
    return value


def _checked(value: object, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise RefusedError(f"{name}: not a number")
    if isinstance(value, int) and abs(value) > 2**63:
        raise RefusedError(f"{name}: too large")
    if not math.isfinite(value):
        raise RefusedError(f"{name}: not finite")
    return value


def _real(table: Table, name: str) -> float:
    """Return a number that is at least 0."""
    value = _checked(_value(table, name), name)
    if value < 0:
        raise RefusedError(f"{name}: below 0")
    return value


def _rate(table: Table, name: str) -> float:
    value = _real(table, name)
    if not 1e-6 <= value <= 1e5:
        raise RefusedError(f"{name}: not from 1e-6 to 1e5")
    return value


def _whole(table: Table, name: str) -> int:
    value = _real(table, name)
    if not isinstance(value, int):
        raise RefusedError(f"{name}: not a whole number")
    return value


def _row(table: Table, name: str) -> Sequence[float]:
    value = _value(table, name)
    if not isinstance(value, list) or not value:
        raise RefusedError(f"{name}: not a list of numbers")
    _require_few(len(value), name)
    return [_checked(entry, name) for entry in value]


def _require_few(numbers: int, name: str) -> None:
    """Refuse a matrix or a list that no loop has, before its numbers are read."""
    if numbers > _MOST_NUMBERS:
        raise RefusedError(f"{name}: more than {_MOST_NUMBERS:,} numbers")


def _symmetric(table: Table, name: str, size: int) -> arb_mat:
    """Return a symmetric matrix, to the last bit: noack reads one of its triangles."""
    M = matrix(_matrix(table, name))
    if (M.nrows(), M.ncols()) != (size, size):
        raise RefusedError(f"{name}: not {size} x {size}")
    if transpose(M) != M:
        raise RefusedError(f"{name}: not symmetric, to the last bit")
    return M


def _matrix(table: Table, name: str) -> Rows:
    value = _value(table, name)
    if not isinstance(value, list) or not value:
        raise RefusedError(f"{name}: not a matrix")
    _require_few(sum(len(row) for row in value if isinstance(row, list)), name)
    rows = [_row({name.rpartition(".")[2]: row}, name) for row in value]
    if any(len(row) != len(rows[0]) for row in rows):
        raise RefusedError(f"{name}: rows of different lengths")
    return rows
