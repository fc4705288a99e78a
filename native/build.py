"""Builds the core: a shared library of native/*.c, and the declarations of public.h for cffi.

``make setup`` and the wheel's build call it. It takes a few seconds, and nothing if no source has
changed. Without a C compiler on the path it uses the one of the package ziglang, if that is there;
the library of another platform is always built by it.
"""

import argparse
import fcntl
import hashlib
import importlib.util
import io
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import redirect_stdout
from pathlib import Path

HERE = Path(__file__).resolve().parent
INTO = HERE.parent / "netem" / "core"
LIBRARY, HEADER = "libnoack.so", "_core_header.py"
PLATFORMS = {
    "manylinux_2_17_x86_64": "x86_64-linux-gnu.2.17",
    "manylinux_2_17_aarch64": "aarch64-linux-gnu.2.17",
    "macosx_11_0_arm64": "aarch64-macos.11.0",
    "macosx_10_13_x86_64": "x86_64-macos.10.13",
    "win_amd64": "x86_64-windows-gnu",
}
"""The platforms for which ``make dist`` builds wheels, each by its tag: ziglang's names of them."""
OWN = f"{sys.platform}_{platform.machine()}".lower()
"""The platform of this machine."""
_LIVE = ("driver/driver.c", "driver/sockets.c", "driver/*tags.c", "relay/*.c")
"""Sockets and timers of live runs: only Linux has them. Elsewhere the library is without them."""
_SCRATCH = ".building-"
_STATES = "states.c"
"""The exact simulator's code for a fixed number of states; it is compiled for each of these:"""
_SIZES = (64, 16, 8, 4, 3)
_FOUR_TAGS = "four_tags.c"
"""Tags of several datagrams at once, for which an x86-64 needs AVX2."""
_FUSED = ("-DFUSED", "-mavx2", "-mfma")
# The vectors stay 256 bits wide: twice as many registers are what speeds the code up.
_WIDE = (
    "-DWIDE",
    "-mavx512f",
    "-mavx512vl",
    "-mavx512dq",
    "-mprefer-vector-width=256",
)
NO_COMPILER = 3
"""Exit status if there is no C compiler."""
# No contraction of a·b + c: results have the same bits on every processor.
FLAGS = (
    "-std=c11", "-O3", "-fPIC", "-fvisibility=hidden", "-ffp-contract=off",
    "-fno-math-errno", "-g0", "-Wall", "-Wextra", "-Wconversion",
)  # fmt: skip
SANITIZERS = (
    "-fsanitize=address,undefined,float-cast-overflow",
    "-fno-sanitize-recover=all",
    "-g1",  # enough for the lines of a stack trace
    "-Werror",
    "-O1",
)


class NoCompilerError(Exception):
    """There is no C compiler."""


def compiler(target: str = OWN) -> list[str]:
    """Return the command of a C compiler: $CC, cc, gcc or clang, or that of ziglang.

    Raises:
        NoCompilerError: there is none.
    """
    ziglang = [sys.executable, "-m", "ziglang", "cc"]
    if target != OWN:
        if importlib.util.find_spec("ziglang"):
            return [*ziglang, "-target", PLATFORMS[target]]
        raise NoCompilerError("the core of another platform needs the Python package ziglang")
    if own := shlex.split(os.environ.get("CC", "")):
        if shutil.which(own[0]) is None:
            raise NoCompilerError(f"CC={shlex.quote(os.environ['CC'])}: there is no {own[0]}")
        return own
    for name in ("cc", "gcc", "clang"):
        if shutil.which(name):
            return [name]
    if importlib.util.find_spec("ziglang"):
        # Not for this machine's processor only, as the other compilers do it.
        return [*ziglang, "-mcpu=baseline"]
    raise NoCompilerError(
        "noack's core needs a C compiler: install gcc or clang (Debian: apt-get install gcc "
        "libc6-dev), or the Python package ziglang"
    )


def sources(target: str = OWN) -> list[Path]:
    """Return the C files of a platform's core, in a fixed order."""
    live = {file for pattern in _LIVE for file in HERE.glob(pattern)}
    return sorted({*HERE.glob("**/*.c")} - (set() if "linux" in target else live))


def declarations() -> str:
    """Return what Python knows of the library: the public headers, and the function below."""
    headers = re.findall(r'^#include "(.*public\.h)"$', (HERE / "core.h").read_text(), re.MULTILINE)
    return "".join((HERE / name).read_text() for name in headers) + "const char *noack_sources(void);\n"


def is_current(into: Path = INTO, files: Sequence[str] = (LIBRARY, HEADER), target: str = OWN) -> bool:
    """Return whether a folder has files of the present sources."""
    digest = _digest(target).encode()
    paths = [into / name for name in files]
    return all(path.exists() and digest in path.read_bytes() for path in paths)


def build(into: Path = INTO, *more_flags: str, library_alone: bool = False, target: str = OWN) -> bool:
    """Build library and declarations into a folder; return whether anything had changed.

    Each file is replaced as a whole, and one build waits for another. Both files contain the digest
    of the sources: the loader compares them. The declarations need cffi, the library does not.

    Raises:
        NoCompilerError: there is no C compiler.
        subprocess.CalledProcessError: the compiler reports a mistake.
    """
    into.mkdir(parents=True, exist_ok=True)
    folder = os.open(into, os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        files = [LIBRARY] if library_alone else [LIBRARY, HEADER]
        if not (missing := [name for name in files if not is_current(into, [name], target)]):
            return False
        for left in into.glob(f"{_SCRATCH}*"):  # by a build that was killed
            shutil.rmtree(left)
        with tempfile.TemporaryDirectory(prefix=_SCRATCH, dir=into) as name:
            scratch = Path(name)
            if LIBRARY in missing:
                print("building the core in C ...", flush=True)
                _compile(scratch, more_flags, target)
            if HEADER in missing:
                _write_declarations(scratch, target)
            for file in missing:
                (scratch / file).replace(into / file)
        for old in into.glob(f"__pycache__/{Path(HEADER).stem}.*"):  # maybe of the same second
            old.unlink(missing_ok=True)
        return True
    finally:
        os.close(folder)


def _compile(into: Path, more_flags: tuple[str, ...], target: str = OWN, *, one_size: bool = False) -> None:
    """Compile the library; ``one_size`` leaves out the exact simulator's code of most sizes."""
    is_linux = "linux" in target
    command = [*compiler(target), *FLAGS, *more_flags]
    if is_linux:
        command.append("-fno-semantic-interposition")
    digest = into / "sources.c"
    digest.write_text(
        '__attribute__((visibility("default"))) const char *noack_sources(void);\n'
        f'const char *noack_sources(void) {{ return "{_digest(target)}"; }}\n'
    )

    def compile_one(unit: tuple[int, tuple[Path, tuple[str, ...]]]) -> str:
        number, (file, own) = unit
        result = str(into / f"{file.stem}-{number}.o")
        subprocess.run([*command, *own, "-c", str(file), "-o", result], check=True)
        return result

    units = [
        (file, flags) for file, flags in _units(target)
        if file.name != _STATES or "-DN=4" in flags or not one_size
    ]  # fmt: skip
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        objects = [*pool.map(compile_one, enumerate([*units, (digest, ())]))]
    command += ["-shared", *objects, "-o", str(into / LIBRARY)]
    if is_linux:  # the core's own calls go directly to its functions, not through a table
        command += ["-Wl,-Bsymbolic", "-lm"]
    elif target.startswith(("macosx", "darwin")):  # its name; otherwise it is its path
        command.append(f"-Wl,-install_name,{LIBRARY}")
    subprocess.run(command, check=True)


def _units(target: str) -> list[tuple[Path, tuple[str, ...]]]:
    """Return the files to compile, each with its own flags; those that take longest are first."""
    states = HERE / "exact" / _STATES
    sizes: list[tuple[str, ...]] = [(f"-DN={size}",) for size in _SIZES]
    tags: tuple[str, ...] = ()
    if target.endswith(("x86_64", "amd64")):  # three sizes without AVX2 and FMA
        fused = [(*size, *_FUSED) for size in sizes]
        wide = [(size, *_FUSED, *_WIDE) for size in ("-DN=8", "-DN=4")]
        sizes = [*fused, *wide, ("-DN=64",), ("-DN=4",), ("-DN=3",)]
        tags = ("-mavx2",)
    return [
        *((states, flags) for flags in sizes),
        *((file, tags if file.name == _FOUR_TAGS else ()) for file in sources(target) if file != states),
    ]


def _write_declarations(into: Path, target: str) -> None:
    from cffi import FFI

    ffi = FFI()
    ffi.cdef(declarations())
    ffi.set_source("netem.core._core_header", None)
    path = into / HEADER
    with redirect_stdout(io.StringIO()):  # cffi prints its progress
        ffi.emit_python_code(str(path))
    path.write_text(f"{path.read_text()}SOURCES = {_digest(target)!r}\n")


def _digest(target: str) -> str:
    """Return a digest of all that the library depends on."""
    digest = hashlib.blake2b(target.encode(), digest_size=16)
    for file in (*sources(target), *sorted(HERE.glob("**/*.h")), Path(__file__)):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def main() -> int:
    """Build from the command line; print a line if something is built."""
    parser = argparse.ArgumentParser(description="Build the core in C.")
    parser.add_argument("--into", type=Path, default=INTO, help="folder of the library")
    parser.add_argument("--check", action="store_true", help="compile without output; warnings are errors")
    parser.add_argument("--sanitized", action="store_true", help="with ASan and UBSan; needs --into")
    parser.add_argument("--library", action="store_true", help="build only the library (cffi is not needed)")
    parser.add_argument("--platforms", action="store_true", help="print the platforms of the wheels")
    given = parser.parse_args()
    if given.platforms:
        print(*PLATFORMS)
        return 0
    if given.sanitized and given.into == INTO:
        parser.error("--sanitized: noack cannot load this library; give another folder by --into")
    try:
        if given.check:
            with tempfile.TemporaryDirectory() as scratch:
                # In a fifth of the time. tests/native builds the whole with sanitizers, -Werror too.
                _compile(Path(scratch), ("-Werror", "-O1"), one_size=True)
        else:
            flags = SANITIZERS if given.sanitized else ()
            build(given.into, *flags, library_alone=given.library)
    except NoCompilerError as error:
        print(error, file=sys.stderr)
        return NO_COMPILER
    except subprocess.CalledProcessError as error:
        command = shlex.join(error.cmd[:3])
        print(f"the core cannot be built: `{command} ...` reports the above", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
