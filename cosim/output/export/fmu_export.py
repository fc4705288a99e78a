"""The channel and the controller of a scenario as Functional Mock-up Units: FMI 3.0, co-simulation.

An FMU has a copy of the core's library, whose native/fmi/ has the functions of FMI, and an image:
the structures of the core that a run would have, with their arrays, as if they were at address 0.
"""

import io
import re
import sys
import zipfile
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from platform import machine
from typing import TYPE_CHECKING, NamedTuple
from xml.etree import ElementTree as ET

from controller_node.controller import controllers_of
from netem.channel import UPDATE_LINK, Channel, alone
from netem.link_state import LinkState
from noack.core.clock import NS_PER_S
from noack.core.core_library import (
    LIBRARY,
    SCRATCH_MATRICES,
    SOURCES,
    CData,
    core,
    ffi,
)
from noack.core.errors import CallerError
from noack.core.file_access import write_whole
from noack.protocol.wire_format import KEY_BYTES, Flow
from noack.scenario.resolution import loop_of, resolved_loops
from noack.scenario.scenario import Scenario

if TYPE_CHECKING:
    from cosim.output.export import ExportedRun

SUFFIX = ".fmu"
_PACKETS = 8
"""Most packets that can arrive in a communication step."""
_DOUBLED = 4
"""How often the room for delayed packets is doubled."""
_NO_HORIZON_NS = 2**60
_SYSTEMS = {"linux": ("linux", ".so"), "darwin": ("darwin", ".dylib"), "win32": ("windows", ".dll")}
_PROCESSORS = {"amd64": "x86_64", "arm64": "aarch64"}
_DATE = (1980, 1, 1, 0, 0, 0)
"""Of all files, so that the same scenario gives the same bytes."""


class _Variable(NamedTuple):
    """A variable; its place in the table is its value reference."""

    name: str
    of_channel: str
    """Its causality there; empty if the channel does not have it."""
    of_controller: str
    is_real: bool
    shape: Sequence[str]
    """Of n, m and packets."""
    description: str

    def causality(self, role: str) -> str:
        return self.of_channel if role == "channel" else self.of_controller


_VARIABLES = (
    _Variable("time", "independent", "independent", True, (), "time"),
    _Variable("send", "input", "", False, (), "packets sent so far; a step may send one"),
    _Variable("x", "input", "", True, ("n",), "what a packet carries: the state"),
    _Variable("arrivals", "output", "input", False, (), "packets that have arrived so far"),
    _Variable(
        "packet_number", "output", "input", False, ("packets",), "number of a packet: from 0"
    ),
    _Variable("packet_sent", "output", "input", True, ("packets",), "when it was sent"),
    _Variable("packet_arrival", "output", "input", True, ("packets",), "when it arrived"),
    _Variable("packet_x", "output", "input", True, ("packets", "n"), "the state in it"),
    _Variable("received", "output", "", False, (), "number of the newest arrival; -1: none"),
    _Variable("received_sent", "output", "", True, (), "when it was sent"),
    _Variable("received_x", "output", "", True, ("n",), "the state in it"),
    _Variable("lost", "output", "", False, (), "packets lost so far"),
    _Variable("longest_burst", "output", "", False, (), "most consecutive losses so far"),
    _Variable("in_flight", "output", "", False, (), "packets delayed at present"),
    _Variable("u", "", "output", True, ("m",), "input of the plant"),
    _Variable("x_c", "", "output", True, ("n",), "state of the controller's model"),
    _Variable("updates", "", "output", False, (), "packets used so far: neither stale nor invalid"),
)
_UNITS = {"time": "s", "packet_sent": "s", "packet_arrival": "s", "received_sent": "s"}


def write(run: "ExportedRun", path: Path, *, certificates: bool = True) -> list[Path]:
    """Write the FMUs of a run's scenario; see :func:`write_scenario`."""
    return write_scenario(run.record.scenario, path)


def write_scenario(scenario: Scenario, path: Path) -> list[Path]:
    """Write ``NAME_channel.fmu`` and ``NAME_controller.fmu`` beside a path ``NAME.fmu``.

    Raises:
        CallerError: the scenario has something that an FMU cannot have.
        MachineError: a file cannot be written.
    """
    alone(scenario)
    network, kind = scenario.network, scenario.controller.kind
    if network.flows != (Flow.UPDATE,):
        raise CallerError("network.actuation: the FMUs have the way to the controller only")
    if not scenario.controller.is_linear:
        raise CallerError(f'controller.kind = "{kind}": an FMU has no Python; set kind = "linear"')
    (resolved,) = resolved_loops(scenario)
    written = []
    for role in ("channel", "controller"):
        model = _Model(resolved, role)
        written.append(write_whole(path.with_name(f"{path.stem}_{role}{SUFFIX}"), model.archive()))
    return written


class _Image:
    """The bytes of an image, and its pointers."""

    def __init__(self) -> None:
        self.data, self.pointers = bytearray(), list[tuple[int, int]]()

    def add(self, rows: CData) -> int:
        """Append what ``ffi.buffer`` takes; return its place."""
        place, content = len(self.data), bytes(rows)
        self.data += content + bytes(-len(content) % 8)
        return place

    def structure(
        self, found: CData, rows: Mapping[str, int], places: Mapping[str, int] | None = None
    ) -> int:
        """Append a copy of a structure and of its arrays; return its place.

        Args:
            found: a pointer to it.
            rows: the number of rows of each array, by the name of the pointer; a dot separates the
                names of inner structures.
            places: where the targets of other pointers are.
        """
        kind = ffi.typeof(found).item
        place = self.add(ffi.buffer(found))
        for name, count in rows.items():
            array = found
            for part in name.split("."):
                array = getattr(array, part)
            if array != ffi.NULL:
                size = count * ffi.sizeof(ffi.typeof(array).item)
                self._point(place + _offset(kind, name), self.add(ffi.buffer(array, size)))
        for name, target in (places or {}).items():
            self._point(place + _offset(kind, name), target)
        return place

    def _point(self, place: int, target: int) -> None:
        self.pointers.append((place, target))
        self.data[place : place + 8] = target.to_bytes(8, sys.byteorder)


def _offset(kind: CData, name: str) -> int:
    return int(ffi.offsetof(kind, *(int(p) if p.isdigit() else p for p in name.split("."))))


class _Model:
    """An FMU.

    Args:
        resolved: the resolved scenario.
        role: channel or controller.
    """

    def __init__(self, resolved: Scenario, role: str) -> None:
        self._scenario, self._role = resolved, role
        self._identifier = re.sub(r"\W|^(?=\d)", "_", f"{resolved.name}_{role}", flags=re.ASCII)
        loop = loop_of(resolved)
        self._sizes = {"n": len(loop.H), "m": loop.m, "packets": _PACKETS}
        self._variables = [
            (reference, variable)
            for reference, variable in enumerate(_VARIABLES)
            if variable.causality(role)
        ]

    def archive(self) -> bytes:
        """Return the file."""
        image = self._image()
        system, ending = _SYSTEMS[sys.platform]
        processor = _PROCESSORS.get(machine().lower(), machine().lower())
        files = {
            "modelDescription.xml": self._description(image[: core.NOACK_TAG_BYTES].hex()),
            "resources/noack.bin": image,
            f"binaries/{processor}-{system}/{self._identifier}{ending}": LIBRARY.read_bytes(),
        }
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in files.items():
                archive.writestr(zipfile.ZipInfo(name, _DATE), content, zipfile.ZIP_DEFLATED)
        return buffer.getvalue()

    def _image(self) -> bytes:
        image, head = _Image(), ffi.new("noack_fmu_image *")
        image.add(ffi.buffer(head))
        head.sources, head.n, head.packets = SOURCES.encode(), self._sizes["n"], _PACKETS
        if self._role == "channel":
            head.channel_at = _add_channel(image, self._scenario)
        else:
            head.controller_at = _add_controller(image, self._scenario)
        for values in head.values:
            values.at = len(image.data)
        for reference, variable in self._variables:
            values = head.values[reference]
            numbers = self._start(variable)
            kind = "double[]" if variable.is_real else "int64_t[]"
            values.count, values.is_real = len(numbers), variable.is_real
            values.is_input = variable.causality(self._role) == "input"
            values.at = image.add(ffi.buffer(ffi.new(kind, numbers)))
        pointers = ffi.new("noack_fmu_pointer[]", image.pointers)
        head.pointer_count, head.pointers_at = len(pointers), image.add(ffi.buffer(pointers))
        head.bytes = len(image.data)
        image.data[: ffi.sizeof("noack_fmu_image")] = ffi.buffer(head)
        wire, tag = ffi.new("noack_wire *"), ffi.new(f"uint8_t[{core.NOACK_TAG_BYTES}]")
        core.noack_wire_key(wire, bytes(KEY_BYTES))
        content = bytes(image.data[len(tag) :])
        core.noack_wire_tag(wire, len(content), content, tag)
        return bytes(tag) + content

    def _start(self, variable: _Variable) -> list[float]:
        count = 1
        for dimension in variable.shape:
            count *= self._sizes[dimension]
        return [-1 if variable.name == "received" else 0] * count

    def _description(self, token: str) -> bytes:
        """Return the content of modelDescription.xml."""
        timing, name = self._scenario.timing, self._scenario.name
        root = ET.Element(
            "fmiModelDescription",
            fmiVersion="3.0",
            modelName=f"{name} {self._role}",
            instantiationToken=token,
            generationTool=f"noack {version('noack')}",
            description=f"The {self._role} of noack's scenario {name}",
            license="Apache-2.0",
        )
        ET.SubElement(
            root,
            "CoSimulation",
            modelIdentifier=self._identifier,
            canHandleVariableCommunicationStepSize="true",
            canGetAndSetFMUState="true",
            canSerializeFMUState="true",
        )
        unit = ET.SubElement(ET.SubElement(root, "UnitDefinitions"), "Unit", name="s")
        ET.SubElement(unit, "BaseUnit", s="1")
        ET.SubElement(ET.SubElement(root, "LogCategories"), "Category", name="logStatusError")
        ET.SubElement(
            root,
            "DefaultExperiment",
            startTime="0",
            stopTime=str(timing.horizon_ns / NS_PER_S),
            stepSize=str(timing.plant_period_ns / NS_PER_S),
        )
        variables = ET.SubElement(root, "ModelVariables")
        structure = ET.SubElement(root, "ModelStructure")
        for reference, variable in self._variables:
            self._describe(variables, reference, variable)
        for tag in ("Output", "InitialUnknown"):
            for reference, variable in self._variables:
                if variable.causality(self._role) == "output":
                    ET.SubElement(structure, tag, valueReference=str(reference))
        ET.indent(root)
        text: bytes = ET.tostring(root, "utf-8", xml_declaration=True)
        return text

    def _describe(self, variables: ET.Element, reference: int, variable: _Variable) -> None:
        causality = variable.causality(self._role)
        attributes = {
            "name": variable.name,
            "valueReference": str(reference),
            "causality": causality,
            "variability": "continuous" if causality == "independent" else "discrete",
            "description": variable.description,
        }  #
        if causality == "input":
            attributes["start"] = " ".join(map(str, self._start(variable)))
        if unit := _UNITS.get(variable.name):
            attributes["unit"] = unit
        tag = "Float64" if variable.is_real else "Int64"
        element = ET.SubElement(variables, tag, attributes)
        for dimension in variable.shape:
            ET.SubElement(element, "Dimension", start=str(self._sizes[dimension]))


def _add_channel(image: _Image, resolved: Scenario) -> int:
    state = LinkState(resolved.network.link, resolved.seeds.loss, UPDATE_LINK)
    channel, link = Channel([state]), state.core
    for _ in range(_DOUBLED):
        channel.answer(core.NOACK_ASK_PLACES)
    channel.core.row_places = 1  # there is no record
    link_at = image.structure(
        link,
        {
            "stages": link.stage_count,
            "integers": link.integer_count,
            "reals": link.real_count,
            "windows": link.window_count,
            "decisions": 0,
            "decisions_begin": 1,
            "flows": 1,
            "memory": link.stage_count,
            "recent_ns": link.recent_width,
            "losses": link.loss_width,
            "queues": link.stage_count,
            "departures_ns": link.departure_places,
        },
    )
    places = channel.core.places
    return image.structure(
        channel.core,
        {"heap": places, "delayed": places, "packets": 1, "releases": 1},
        {"links.0": link_at},
    )


def _add_controller(image: _Image, resolved: Scenario) -> int:
    machines = controllers_of([resolved])
    controller = machines.machines + 0  # a pointer to the first one
    model, n, m = controller.model, controller.machine.n, controller.machine.m
    controller.machine.horizon_ns = controller.machine.received.not_after_ns = _NO_HORIZON_NS
    transitions = model.transitions
    places = transitions.places
    transitions_at = image.structure(
        transitions,
        {
            "H": n * n,
            "steps_ns": places,
            "matrices": places * n * n,
            "scratch": SCRATCH_MATRICES * n * n + 3 * n,
        },
    )
    return image.structure(
        controller,
        {
            "model.since_ns": 1,
            "model.has_point": 1,
            "model.points": n,
            "K": m * n,
            "x_r": n,
            "u_r": m,
            "safe_input": m,
            "x_c": n,
            "x": n,
            "u": m,
            "scratch": 3 * n + m,
        },
        {"model.transitions": transitions_at},
    )
