"""ziglang builds the core for other platforms; a wheel's tag says what its library needs."""

import re
import subprocess
from importlib.util import find_spec
from pathlib import Path

import pytest

from native.build import FLAGS, LIBRARIES, NETEM, NOACK, build, compiler, sources

pytestmark = pytest.mark.system
FORMATS = {  # the first bytes: the format, and the processor at its place
    "manylinux_2_17_aarch64": (b"\x7fELF", 18, b"\xb7\x00"),
    "macosx_11_0_arm64": (b"\xcf\xfa\xed\xfe", 4, b"\x0c\x00\x00\x01"),
}


needs_ziglang = pytest.mark.skipif(
    find_spec("ziglang") is None, reason="the package ziglang is not installed"
)


@needs_ziglang
@pytest.mark.parametrize("platform", FORMATS)
@pytest.mark.parametrize("name", LIBRARIES)
def test_a_platform_has_its_libraries(name: str, platform: str, tmp_path: Path) -> None:
    of = LIBRARIES[name]
    build(of, tmp_path, "-O0", "-Werror", target=platform)  # as it is built, but in less time
    library = (tmp_path / of.file).read_bytes()
    start, place, processor = FORMATS[platform]
    assert (library[: len(start)], library[place:][: len(processor)]) == (start, processor)
    function, of_live_runs = {
        "netem": (b"noack_link_decide", b"noack_relay_run"),
        "noack": (b"noack_exact_runs", b"noack_drive"),
    }[name]
    assert function in library
    assert (of_live_runs + b"\0" in library) == ("linux" in platform)
    assert str(tmp_path).encode() not in library
    versions = [(2, int(minor)) for minor in re.findall(rb"GLIBC_2\.(\d+)", library)]
    assert max(versions, default=(2, 17)) == (2, 17)


@needs_ziglang
def test_windows_can_compile_every_file(tmp_path: Path) -> None:
    """It is linked by ``make dist`` only: ziglang first builds Windows' libraries for minutes."""
    command = [*compiler("win_amd64"), *FLAGS, "-Werror", "-O0", "-c", "-DN=4"]
    for file in {*sources(NETEM, "win_amd64"), *sources(NOACK, "win_amd64")}:
        subprocess.run([*command, str(file), "-o", str(tmp_path / f"{file.stem}.o")], check=True)
