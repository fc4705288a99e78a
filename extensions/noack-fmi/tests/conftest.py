"""Builds FMUs for tests from C sources, with a model description that a test may change."""

import inspect
import shutil
import subprocess
import zipfile
from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from typing import Protocol

import fmpy
import pytest
from fmpy import fmi2, fmi3

SOURCE = Path(__file__).with_name("oscillator.c")
VARIABLES = (
    ("x0", "Real", "output", "continuous", "exact", "0"),
    ("x1", "Real", "output", "continuous", "exact", "0"),
    ("u", "Real", "input", "continuous", None, "0"),
    ("mu", "Real", "parameter", "tunable", "exact", "1"),
    ("k", "Real", "parameter", "tunable", "exact", "1"),
    ("linear", "Boolean", "parameter", "fixed", "exact", "false"),
    ("energy", "Real", "local", "continuous", "calculated", None),
    ("fail_at_s", "Real", "parameter", "fixed", "exact", "1e9"),
    ("fail_status", "Integer", "parameter", "fixed", "exact", "0"),
    ("noisy", "Boolean", "parameter", "fixed", "exact", "false"),
    ("x0_at_the_start", "Real", "parameter", "fixed", "exact", "0"),
    ("name", "String", "parameter", "fixed", "exact", "o"),
)
_TYPES_3 = {"Real": "Float64", "Integer": "Int32"}


class Build(Protocol):
    """Build the oscillator for an FMI version; ``edit`` replaces text of its model description."""

    def __call__(self, folder: Path, version: int, *, edit: tuple[str, str] | None = None) -> Path: ...


@pytest.fixture
def build() -> Build:
    return _build


def _build(folder: Path, version: int, *, edit: tuple[str, str] | None = None) -> Path:
    description = _description(version)
    if edit is not None:
        assert edit[0] in description
        description = description.replace(*edit)
    platform = fmpy.platform if version == 2 else fmpy.platform_tuple
    path = folder / f"oscillator{version}.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", description)
        library = f"oscillator{fmpy.sharedLibraryExtension}"
        archive.writestr(f"binaries/{platform}/{library}", _compiled(version))
    return path


@cache
def _compiled(version: int) -> bytes:
    """The shared library; all functions that noack does not use fail."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler (cc) to build an FMU with")
    slave = fmi2.FMU2Slave if version == 2 else fmi3.FMU3Slave
    source = SOURCE.read_text()
    wanted = [name for name, _ in inspect.getmembers(slave) if name.startswith(f"fmi{version}")]
    stubs = [f"int {name}(void) {{ return 3; }}" for name in wanted if f"{name}(" not in source]
    folder = Path(mkdtemp())
    try:
        code, library = folder / "fmu.c", folder / "fmu.so"
        code.write_text(source + "\n".join(stubs))
        subprocess.run(
            [compiler, "-O1", "-ffp-contract=off", "-shared", "-fPIC", f"-DFMI={version}",
             "-o", library, code, "-lm"],
            check=True,
        )  # fmt: skip
        return library.read_bytes()
    finally:
        shutil.rmtree(folder)


def _description(version: int) -> str:
    variables = "\n".join(_variable(version, number, *variable) for number, variable in enumerate(VARIABLES))
    identity, structure = {
        2: ("guid", '<Outputs><Unknown index="1"/><Unknown index="2"/></Outputs>'),
        3: ("instantiationToken", '<Output valueReference="0"/><Output valueReference="1"/>'),
    }[version]
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="{version}.0" modelName="Oscillator" {identity}="{{oscillator}}"
 generationTool="noack's tests">
<CoSimulation modelIdentifier="oscillator" canHandleVariableCommunicationStepSize="true"/>
<ModelVariables>{variables}</ModelVariables>
<ModelStructure>{structure}</ModelStructure>
</fmiModelDescription>"""


def _variable(version: int, number: int, name: str, kind: str, *given: str | None) -> str:
    keys = ("causality", "variability", "initial")
    attributes = f'name="{name}" valueReference="{number}"' + "".join(
        f' {key}="{value}"' for key, value in zip(keys, given, strict=False) if value is not None
    )
    start = "" if given[3] is None else f' start="{given[3]}"'
    if version == 2:
        return f"<ScalarVariable {attributes}><{kind}{start}/></ScalarVariable>"
    if kind == "String":
        return f'<String {attributes}><Start value="{given[3]}"/></String>'
    return f"<{_TYPES_3.get(kind, kind)} {attributes}{start}/>"
