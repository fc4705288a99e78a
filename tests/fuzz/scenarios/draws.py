"""Whole random scenarios: a function of a seed and a number, written as a scenario file."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import tomli_w

from netem.core.toml_file import json_schema
from noack.plants.linear import NAMED_MODELS
from noack.references.segment import SolutionSegment
from noack.scenario.scenario import Scenario
from tests.fuzz.scenarios.chances import Chances, Table
from tests.fuzz.scenarios.loop_draws import Model, loop, setpoint, trigger
from tests.fuzz.scenarios.network_draws import constraints, loss, network

FILE = "scenario.toml"
_LOOP_SEEDS = ("plant", "initial_state", "disturbance", "noise")

NEVER_DRAWN: Mapping[str, str] = {
    "ModelSection.load_states": "of resolved scenarios, which have the loads in their matrices",
    "ModelSection.controller_states": "of resolved scenarios, which have these states in their matrices",
    "PythonControllerSettings.sha256": "the user's own copy in a run directory",
    "PythonPlantSettings.sha256": "the user's own copy in a run directory",
    "PythonTriggerSettings.sha256": "the user's own copy in a run directory",
    "PythonControllerSettings.setpoint": "what the loop follows is up to the user's class",
    "PythonControllerSettings.update_timeout_s": "refused: it needs u = K x_c",
    "PythonControllerSettings.reference": "what the loop follows is up to the user's class",
    "KalmanSettings.gains": "of resolved scenarios",
    "LyapunovSettings.P": "of resolved scenarios",
    "DynamicSettings.P": "of resolved scenarios",
    **dict.fromkeys(
        (f"SolutionSegment.{key}" for key in SolutionSegment.model_fields), "what a resolved scenario has"
    ),
    **dict.fromkeys(("FilePiece.t_s", "FilePiece.x", "FilePiece.u"), "what is read from a file"),
    "PythonPlantSettings.on_record": "names methods of a plant that writes files of its own",
}
"""Keys that no draw has, and why."""


class Draw(NamedTuple):
    """A random scenario, and the files that it names."""

    seed: int
    number: int
    content: Table
    files: Mapping[str, str | bytes]

    def write(self, folder: Path) -> Path:
        """Write the scenario and its files into a folder; return the scenario's path."""
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in self.files.items():
            data = content.encode() if isinstance(content, str) else content
            (folder / name).write_bytes(data)
        path = folder / FILE
        path.write_text(tomli_w.dumps(self.content))
        return path


def draw(seed: int, number: int) -> Draw:
    """Return a scenario; the same arguments give the same one."""
    of = Chances(seed, number)
    horizon_s = of.between(1.0, 4.0)
    acknowledged = of.chance(0.07)
    tables, model = loop(of, acknowledged=acknowledged)
    entries = [] if of.chance(0.75) else _loops(of, tables, model, acknowledged=acknowledged)
    count = sum(entry.get("count", 1) for entry in entries) or 1
    content: Table = {"name": f"draw_{seed}_{number}", "horizon_s": horizon_s, **tables}
    of.put(content, 0.1, "description", lambda: "a random scenario")
    content["network"] = network(of, count, horizon_s, acknowledged=acknowledged)
    of.put(content, 0.95, "certificate", lambda: _certificate(of))
    if not acknowledged:
        often = 0.1 if of.gentle else 0.25
        of.put(content, often, "changes", lambda: _changes(of, content, model, horizon_s))
    if entries:
        content["loops"] = entries
    seeds = ("plant", "initial_state", "loss", "disturbance", "noise")
    of.put(content, 0.8, "seeds", lambda: _some(of, {key: of.integer(0, 2**40) for key in seeds}))
    _without_effect(of, content)
    if of.chance(0.15) and not acknowledged and not entries:
        _follow(of, content, model)
    return Draw(seed, number, content, of.files)


def _follow(of: Chances, content: Table, model: Model) -> None:
    """Add a reference, if nothing else excludes one."""
    controller, names = content.setdefault("controller", {}), content["model"].get("state_names")
    moved = any("setpoint" in key for change in content.get("changes", ()) for key in change["set"])
    carries_model = content["plant"].get("watchdog", {}).get("policy") == "model"
    kind = controller.get("kind", "linear")
    if moved or carries_model or "setpoint" in controller or kind not in ("linear", "state_space"):
        return
    has_states = kind == "state_space" or "integral" in content["model"]  # a file does not have them
    if "name" in content["model"]:
        names = names or NAMED_MODELS[content["model"]["name"]]().state_names
    names = names or [f"x_{i}" for i in range(1, model.n + 1)]
    if of.chance(0.2) and not has_states:
        inputs = content["model"].get("input_names") or [f"u_{i}" for i in range(1, model.m + 1)]
        if "name" in content["model"]:
            return
        columns = ["t_s", *names, *inputs]
        zeros = ",".join("0" * len(columns))
        text = f"{','.join(columns)}\n{zeros}\n{content['horizon_s']}{zeros[1:]}\n"
        piece: Table = {"kind": "file", "file": of.file("reference", ".csv", text)}
        of.put(piece, 0.5, "tolerance", lambda: of.size(1e-9, 1e-3))
        controller["reference"] = [piece]
        return
    output = of.one_of(*names)
    controller["reference"] = [_piece(of, output, 0.0, 0.4), _piece(of, output, 0.5, 0.9)]


def _piece(of: Chances, output: str, earliest_s: float, latest_s: float) -> Table:
    """Return a piece of a reference that begins and ends within a time."""
    kinds: list[Table] = [
        {"kind": "step", "value": of.between(-0.1, 0.1)},
        {"kind": "ramp", "rate_per_s": of.between(-0.1, 0.1)},
        {"kind": "sine", "amplitude": of.between(0.01, 0.1), "hz": of.between(0.1, 2.0)},
    ]
    piece = of.one_of(*kinds) | {"output": output, "from_s": of.between(earliest_s, latest_s - 0.2)}
    if piece["kind"] == "ramp":
        of.put(piece, 0.3, "value", lambda: of.between(-0.1, 0.1))
    if piece["kind"] == "sine":
        of.put(piece, 0.5, "phase_rad", lambda: of.between(-3.0, 3.0))
        of.put(piece, 0.3, "offset", lambda: of.between(-0.1, 0.1))
    of.put(piece, 0.5, "until_s", lambda: latest_s)
    of.put(piece, 0.5, "join_s", lambda: of.between(0.01, 0.09))
    return piece


def _some(of: Chances, table: Table) -> Table:
    return {key: value for key, value in table.items() if of.chance(0.7)}


def _certificate(of: Chances) -> Table:
    table = {
        "late_periods": of.integer(0, 5),
        "network_delay_s": of.between(0.0, 0.2),
        "exceedance_probability": of.size(1e-9, 1e-2),
        "paper": of.chance(0.5),
    }
    return {"prove": of.chance(0.05), **_some(of, table)}  # the search of a proof takes seconds


def _changes(of: Chances, content: Table, model: Model, horizon_s: float) -> list[Table]:
    times_s = sorted(of.between(0.0, 0.99) * horizon_s for _ in range(of.integer(1, 3)))
    return [{"at_s": at_s, "set": _changed(of, content, model, horizon_s)} for at_s in times_s]


def _changed(of: Chances, content: Table, model: Model, horizon_s: float) -> Table:
    rule = content["trigger"]
    numbers = [key for key in ("beta", "alpha_per_s", "delta", "sigma", "epsilon", "interval_s", "theta_s")
               if key in rule]  # fmt: skip
    table: Table = {}
    of.put(table, 0.4, "network.mansd", lambda: of.integer(0, 5))
    of.put(table, 0.3, "network.loss", lambda: loss(of, horizon_s, changed=True))
    of.put(table, 0.1, "constraints", lambda: constraints(of))
    if numbers:
        key = of.one_of(*numbers)
        of.put(table, 0.4, f"trigger.{key}", lambda: float(f"{rule[key] * of.between(0.5, 1.0):.6g}"))
    linear = content.get("controller", {}).get("kind", "linear") == "linear"
    if linear and content["plant"].get("watchdog", {}).get("policy") != "model":
        of.put(table, 0.3, "controller.setpoint", lambda: setpoint(of, model))
    return table or {"network.mansd": of.integer(0, 4)}


def _loops(of: Chances, tables: Table, model: Model, *, acknowledged: bool) -> list[Table]:
    """Return entries of [[loops]]: copies of the loop, some with another trigger, or another loop."""
    entries: list[Table] = []
    for number in range(of.integer(1, 3)):
        entry: Table = {"name": f"loop-{number}"}
        of.put(entry, 0.3, "count", lambda: of.integer(1, 3))
        of.put(entry, 0.3, "phase", lambda: of.between(0.0, 0.99))
        of.put(entry, 0.2, "mode", lambda: of.one_of("model", "zoh"))
        if of.chance(0.4):
            entry["scenario"] = _loop_file(of, acknowledged=acknowledged)
        elif of.chance(0.3) and "observer" not in tables:
            entry |= _other_tables(of, tables, acknowledged=acknowledged)
        elif of.chance(0.3):
            plant = tables["plant"]
            measured_s = plant.get("measure_every", 1) / plant.get("rate_hz", 500.0)
            rule = trigger(of, model, measured_s)
            entry["trigger"] = {"policy": "decaying", **rule}
        of.put(entry, 0.2, "seeds", lambda: _some(of, {key: of.integer(0, 1000) for key in _LOOP_SEEDS}))
        entries.append(entry)
    return entries


def _loop_file(of: Chances, *, acknowledged: bool) -> str:
    """Add the file of another loop; return its name."""
    tables, _ = loop(of, acknowledged=acknowledged)
    network = {"mansd": 0, "loss": {"model": "lossless"}}
    content = {"name": "other", "horizon_s": 1.0, "network": network, **tables}
    return of.file("loop", ".toml", tomli_w.dumps(content))


def _other_tables(of: Chances, tables: Table, *, acknowledged: bool) -> Table:
    """Return the tables of another loop, none if it would keep keys of a plant of another size."""
    other, _ = loop(of, acknowledged=acknowledged)
    other["controller"] = {"kind": "linear", **other.get("controller", {})}
    other["plant"] = {"rate_hz": 500.0, **other["plant"]}
    return other if tables["plant"].keys() <= other["plant"].keys() else {}


def _without_effect(of: Chances, content: Table) -> None:
    """Draw settings of live runs, which a simulation accepts and ignores."""
    of.put(content, 0.1, "speed", lambda: of.size(0.1, 10.0))
    of.put(content, 0.1, "start_within_s", lambda: of.between(10.0, 100.0))
    of.put(content, 0.1, "clocks", lambda: _some(of, {"largest_error_us": of.size(10.0, 1000.0)}))
    ports = {"plant": 47001, "sensor": 47002, "netem": 47003, "controller": 47004}
    of.put(content, 0.1, "ports", lambda: _some(of, ports))
    realtime = {"enabled": of.flag(), "fifo_priority": of.integer(1, 98), "pin_cores": of.flag(),
                "spin_us": of.between(0, 100)}  # fmt: skip
    of.put(content, 0.1, "realtime", lambda: _some(of, realtime))


def schema_keys() -> set[str]:
    """Return every key of a scenario file, after the name of its table in the schema."""
    schema = json_schema(Scenario)
    tables = {"Scenario": schema, **schema["$defs"]}
    return {f"{name}.{key}" for name, table in tables.items() for key in table.get("properties", {})}


def drawn_keys(content: Table) -> set[str]:
    """Return the keys of a scenario file's content, named as in `schema_keys`."""
    schema = json_schema(Scenario)
    keys = set(_keys(content, schema, schema["$defs"], "Scenario"))
    for entry in content.get("loops", ()):
        for part in ("model", "plant", "trigger", "observer", "controller"):
            if part in entry:
                keys |= set(_keys({part: entry[part]}, schema, schema["$defs"], "Scenario"))
    return keys


def _keys(value: Any, node: Table, tables: Mapping[str, Table], name: str) -> Iterator[str]:
    if "$ref" in node:
        name = node["$ref"].rpartition("/")[2]
        node = tables[name]
    if isinstance(value, list):
        entries = next((n["items"] for n in _nodes(node, tables) if isinstance(n.get("items"), dict)), {})
        for entry in value:
            yield from _keys(entry, entries, tables, name)
    if not isinstance(value, dict):
        return
    if "properties" not in node:
        fitting = _fitting(value, node, tables)
        if fitting is None:
            return
        name, node = fitting
    for key, inner in value.items():
        if key in node["properties"]:
            yield f"{name}.{key}"
            yield from _keys(inner, node["properties"][key], tables, name)


def _nodes(node: Table, tables: Mapping[str, Table]) -> Iterator[Table]:
    if "$ref" in node:
        node = tables[node["$ref"].rpartition("/")[2]]
    yield node
    for inner in (*node.get("anyOf", ()), *node.get("oneOf", ())):
        yield from _nodes(inner, tables)


def _fitting(value: Table, node: Table, tables: Mapping[str, Table]) -> tuple[str, Table] | None:
    """Return the table of a union that a value has the kind of; that of the default without a kind."""
    references = [inner["$ref"] for inner in _with_references(node)]
    names = [reference.rpartition("/")[2] for reference in references]
    for name in names:
        properties = tables[name].get("properties", {})
        constants = {key: inner["const"] for key, inner in properties.items() if "const" in inner}
        if all(value.get(key) == constant for key, constant in constants.items()):
            return name, tables[name]
    defaults = ("LinearFeedbackSettings", "LinearSettings", "DecayingSettings", *names)
    return next(((name, tables[name]) for name in defaults if name in names), None)


def _with_references(node: Table) -> Iterator[Table]:
    if "$ref" in node:
        yield node
    for inner in (*node.get("anyOf", ()), *node.get("oneOf", ())):
        yield from _with_references(inner)
