"""The channel and the controller of a scenario as Functional Mock-up Units: FMI 3.0, co-simulation.

An FMU has a copy of the core's library, whose native/fmi/ has the functions of FMI, and an image:
the structures of the core that a run would have, with their arrays, as if they were at address 0.
"""

import io
import math
import re
import sys
import zipfile
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from platform import machine
from typing import TYPE_CHECKING, NamedTuple

from controller_node.controller import controllers_of
from cosim.record.run_directory import SCENARIO_FILE
from netem.channel import UPDATE_LINK, Channel, require_stand_alone
from netem.link_state import LinkState
from noack.core.clock import NS_PER_S
from noack.core.core_library import LIBRARY, SCRATCH_MATRICES, SOURCES, CData, core, ffi
from noack.core.errors import CallerError
from noack.core.file_access import write_whole
from noack.protocol.wire_format import KEY_BYTES, Flow
from noack.scenario import scenario_file
from noack.scenario.resolution import loop_of, resolved_loops
from noack.scenario.scenario import Scenario

if TYPE_CHECKING:
    from cosim.output.export.export_formats import ExportedRun

SUFFIX = ".fmu"
_PACKETS_PER_STEP = 8
"""Most packets that can arrive in a communication step."""
_MEMORY_DOUBLINGS = 4
"""How often the memory for delayed packets is doubled."""
_NO_HORIZON_NS = 2**60  # later than any simulation
_SYSTEMS = {"linux": ("linux", ".so"), "darwin": ("darwin", ".dylib"), "win32": ("windows", ".dll")}
_PROCESSORS = {"amd64": "x86_64", "arm64": "aarch64"}
"""Names of FMI for systems, with the endings of their libraries, and for processors."""
_FILE_DATE = (1980, 1, 1, 0, 0, 0)
"""Date of all files in the archive, so that the same scenario gives the same bytes."""
_INDEPENDENT, _INPUT, _OUTPUT = "independent", "input", "output"


class _Variable(NamedTuple):
    """A variable; its index in the table is its value reference (``noack_fmu_variable``)."""

    name: str
    channel: str
    """Its causality there; empty if the channel does not have it."""
    controller: str
    is_real: bool
    shape: str
    """Of n, m and p = :data:`_PACKETS_PER_STEP`."""
    description: str


_VARIABLES = (
    _Variable("time", _INDEPENDENT, _INDEPENDENT, True, "", "time"),
    _Variable("send", _INPUT, "", False, "", "packets sent so far; each step may send one more"),
    _Variable("x", _INPUT, "", True, "n", "the state in the packet that is sent"),
    _Variable("arrivals", _OUTPUT, _INPUT, False, "", "packets that have arrived so far"),
    _Variable("packet_number", _OUTPUT, _INPUT, False, "p", "of the last arrivals, newest first"),
    _Variable("packet_sent_s", _OUTPUT, _INPUT, True, "p", "when each was sent"),
    _Variable("packet_arrival_s", _OUTPUT, _INPUT, True, "p", "when each arrived"),
    _Variable("packet_x", _OUTPUT, _INPUT, True, "pn", "the state in each"),
    _Variable("received", _OUTPUT, "", False, "", "highest number that has arrived; -1: none"),
    _Variable("received_sent_s", _OUTPUT, "", True, "", "when that packet was sent"),
    _Variable("received_x", _OUTPUT, "", True, "n", "the state in it"),
    _Variable("lost", _OUTPUT, "", False, "", "packets lost so far"),
    _Variable("longest_burst", _OUTPUT, "", False, "", "most consecutive losses so far"),
    _Variable("in_flight", _OUTPUT, "", False, "", "packets and copies that are delayed"),
    _Variable("u", "", _OUTPUT, True, "m", "input of the plant"),
    _Variable("x_c", "", _OUTPUT, True, "n", "state of the controller's model"),
    _Variable("updates", "", _OUTPUT, False, "", "packets used so far: neither stale nor invalid"),
)
_DESCRIPTION = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName="{scenario} {role}" instantiationToken="{token}"
    generationTool="noack {version}" license="Apache-2.0">
  <CoSimulation modelIdentifier="{identifier}" canHandleVariableCommunicationStepSize="true"
      canGetAndSetFMUState="true" canSerializeFMUState="true"/>
  <LogCategories><Category name="logStatusError"/></LogCategories>
  <DefaultExperiment startTime="0" stopTime="{stop_s}" stepSize="{step_s}"/>
  <ModelVariables>
{variables}
  </ModelVariables>
  <ModelStructure>
{structure}
  </ModelStructure>
</fmiModelDescription>
"""


def write(run: "ExportedRun", path: Path, *, certificates: bool = True) -> list[Path]:
    """Write the FMUs of a run's scenario; see :func:`write_scenario`."""
    return write_scenario(scenario_file.load(run.directory / SCENARIO_FILE), path)


def write_scenario(scenario: Scenario, path: Path) -> list[Path]:
    """Write ``NAME_channel.fmu`` and ``NAME_controller.fmu`` beside a path ``NAME.fmu``.

    Of a folder, the files are in it, and NAME is that of the scenario.

    Raises:
        CallerError: the scenario has something that an FMU cannot have.
        MachineError: a file cannot be written.
    """
    if path.is_dir():
        path /= scenario.name
    if not (name := path.name.removesuffix(SUFFIX)):
        raise CallerError(f"{path}: must be the name of a file, such as loop{SUFFIX}")
    require_stand_alone(scenario)
    kind = scenario.controller.kind
    if scenario.network.flows != (Flow.UPDATE,):
        raise CallerError(
            "network.actuation: an FMU's channel leads to the controller only; remove this table"
        )
    if not scenario.controller.is_linear:
        raise CallerError(f'controller.kind = "{kind}": an FMU has the linear law only, kind = "linear"')
    (resolved,) = resolved_loops(scenario)
    return [
        write_whole(path.with_name(f"{name}_{role}{SUFFIX}"), _archive(resolved, role))
        for role in ("channel", "controller")
    ]


def _archive(resolved: Scenario, role: str) -> bytes:
    """Return the file of an FMU."""
    loop, image = loop_of(resolved), _Image()
    variables: dict[int, tuple[_Variable, list[int]]] = {}
    sizes = {"n": len(loop.H), "m": loop.m, "p": _PACKETS_PER_STEP}
    for reference, variable in enumerate(_VARIABLES):
        if getattr(variable, role):
            variables[reference] = variable, [sizes[name] for name in variable.shape]
    if role == "channel":
        image.head.channel_at = _add_channel(image, resolved)
    else:
        image.head.controller_at = _add_controller(image, resolved)
    image.head.n = len(loop.H)
    for reference, (variable, shape) in variables.items():
        numbers = [-1 if variable.name == "received" else 0] * math.prod(shape)
        is_input = getattr(variable, role) == _INPUT
        image.add_variable(reference, numbers, is_real=variable.is_real, is_input=is_input)
    content = image.content()
    identifier = re.sub(r"\W|^(?=\d)", "_", f"{resolved.name}_{role}", flags=re.ASCII)
    description = _model_description(resolved, role, identifier, content, variables)
    system, ending = _SYSTEMS[sys.platform]
    processor = _PROCESSORS.get(machine().lower(), machine().lower())
    files = {
        "modelDescription.xml": description.encode(),
        "resources/noack.bin": content,
        f"binaries/{processor}-{system}/{identifier}{ending}": LIBRARY.read_bytes(),
    }
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(zipfile.ZipInfo(name, _FILE_DATE), data, zipfile.ZIP_DEFLATED)
    return buffer.getvalue()


def _model_description(
    resolved: Scenario,
    role: str,
    identifier: str,
    content: bytes,
    variables: Mapping[int, tuple[_Variable, list[int]]],
) -> str:
    """Return the description of the model, with its variables by their value references."""
    return _DESCRIPTION.format(
        scenario=resolved.name,
        role=role,
        token=content[: core.NOACK_TAG_BYTES].hex(),
        version=version("noack"),
        identifier=identifier,
        stop_s=resolved.timing.horizon_ns / NS_PER_S,
        step_s=resolved.timing.plant_period_ns / NS_PER_S,
        variables="\n".join(_variable_xml(role, ref, *variable) for ref, variable in variables.items()),
        structure="\n".join(
            f'    <{tag} valueReference="{reference}"/>'
            for tag in ("Output", "InitialUnknown")
            for reference, (variable, _) in variables.items()
            if getattr(variable, role) == _OUTPUT
        ),
    )


def _variable_xml(role: str, reference: int, variable: _Variable, shape: list[int]) -> str:
    """Return the element of a variable in the description of the model."""
    causality, tag = getattr(variable, role), "Float64" if variable.is_real else "Int64"
    variability = "continuous" if variable.name in ("time", "x") else "discrete"
    start = " ".join(["0"] * math.prod(shape))
    dimensions = "".join(f'<Dimension start="{size}"/>' for size in shape)
    return (
        f'    <{tag} name="{variable.name}" valueReference="{reference}" causality="{causality}" '
        f'variability="{variability}" description="{variable.description}"'
        + (f' start="{start}"' if causality == _INPUT else "")
        + (f">{dimensions}</{tag}>" if shape else "/>")
    )


class _Image:
    """The bytes of an image, and its pointers."""

    def __init__(self) -> None:
        self.head = ffi.new("noack_fmu_image *", {"sources": SOURCES.encode(), "packets": _PACKETS_PER_STEP})
        self._data, self._pointers = bytearray(ffi.buffer(self.head)), list[tuple[int, int]]()

    def content(self) -> bytes:
        """Return the content of the file."""
        pointers = ffi.new("noack_fmu_pointer[]", self._pointers)
        self.head.pointer_count, self.head.pointers_at = len(pointers), self._add(pointers)
        self.head.bytes = len(self._data)
        for values in self.head.values:
            values.at = values.at or self.head.pointers_at  # of a variable that is not there
        self._data[: ffi.sizeof("noack_fmu_image")] = ffi.buffer(self.head)
        wire, tag = ffi.new("noack_wire *"), ffi.new(f"uint8_t[{core.NOACK_TAG_BYTES}]")
        content = bytes(self._data[len(tag) :])
        core.noack_wire_key(wire, bytes(KEY_BYTES))
        core.noack_wire_tag(wire, len(content), content, tag)
        return bytes(tag) + content

    def add_variable(self, reference: int, numbers: list[int], *, is_real: bool, is_input: bool) -> None:
        """Append the numbers of a variable."""
        offset = self._add(ffi.new("double[]" if is_real else "int64_t[]", numbers))
        self.head.values[reference] = (len(numbers), is_real, is_input, offset)

    def add_structure(
        self, structure: CData, rows: Mapping[str, int], targets: Mapping[str, int] | None = None
    ) -> int:
        """Append a copy of a structure and of its arrays; return its offset.

        Args:
            structure: a pointer to it.
            rows: the number of rows of each array, by the name of the pointer; a dot separates the
                names of inner structures.
            targets: the offsets of what other pointers point to.
        """
        kind, offset = ffi.typeof(structure).item, self._add(structure)
        targets = dict(targets or {})
        for name, count in rows.items():
            array = structure
            for part in name.split("."):
                array = getattr(array, part)
            if array != ffi.NULL:
                targets[name] = self._add(array, count * ffi.sizeof(ffi.typeof(array).item))
        for name, target in targets.items():
            fields = (int(part) if part.isdigit() else part for part in name.split("."))
            pointer_at = offset + ffi.offsetof(kind, *fields)
            self._pointers.append((pointer_at, target))
            self._data[pointer_at : pointer_at + 8] = target.to_bytes(8, sys.byteorder)
        return offset

    def _add(self, rows: CData, size: int = -1) -> int:
        offset, content = len(self._data), bytes(ffi.buffer(rows, size))
        self._data += content + bytes(-len(content) % 8)
        return offset


def _add_channel(image: _Image, resolved: Scenario) -> int:
    """Append the network of the updates, with nothing in flight."""
    state = LinkState(resolved.network.link, resolved.seeds.loss, UPDATE_LINK)
    channel, link = Channel([state]), state.core
    for _ in range(_MEMORY_DOUBLINGS):
        channel.answer(core.NOACK_ASK_PLACES)
    channel.core.row_places = 1  # there is no record
    stages, capacity = link.stage_count, channel.core.places
    of_link = {"stages": stages, "memory": stages, "queues": stages, "flows": 1}
    of_link |= {"integers": link.integer_count, "reals": link.real_count}
    of_link |= {"windows": link.window_count, "decisions": 0, "decisions_begin": 1}
    of_link |= {"recent_ns": link.recent_width, "losses": link.loss_width}
    of_link |= {"departures_ns": link.departure_places}
    link_at = image.add_structure(link, of_link)
    of_channel = {"heap": capacity, "delayed": capacity, "waiting": capacity}
    of_channel |= {"packets": 1, "releases": 1}
    return image.add_structure(channel.core, of_channel, {"links.0": link_at})


def _add_controller(image: _Image, resolved: Scenario) -> int:
    """Append the controller, which goes on beyond the horizon."""
    machines = controllers_of([resolved])
    controller = machines.machines + 0  # a pointer to the first one
    machine, model = controller.machine, controller.model
    machine.horizon_ns = machine.received.not_after_ns = _NO_HORIZON_NS
    n, m, capacity = machine.n, machine.m, model.transitions.places
    of_transitions = {"H": n * n, "steps_ns": capacity, "matrices": capacity * n * n}
    of_transitions |= {"scratch": SCRATCH_MATRICES * n * n + 3 * n}
    transitions_at = image.add_structure(model.transitions, of_transitions)
    rows = {"model.since_ns": 1, "model.has_point": 1, "model.points": n, "K": m * n}
    rows |= {"x_r": n, "u_r": m, "safe_input": m, "x_c": n}
    rows |= {"x": n, "u": m, "scratch": 3 * n + m}
    return image.add_structure(controller, rows, {"model.transitions": transitions_at})
