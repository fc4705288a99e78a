"""Builds the core: two shared libraries of native/*/*.c, and their declarations for cffi.

``netem/core/libnetem.so`` is the network's, ``noack/core/libnoack.so`` the loop's. Simulations drive a
run's network in C, so libnoack has its own copy of the network's code, which is not linked to
libnetem. The copy has 40 KB, 4 % of libnoack. In return no library has to find another one when it is
loaded: on three systems, in wheels, in editable installations, with sanitizers. A link that libnetem
has made may be used by libnoack: both are built from the same structures, memory is the C library's,
and no code of the network has variables of its own. The loader refuses other pairs
(``NETWORK`` in the declarations). Python calls the network's functions in libnetem only.

``make setup`` and the wheels' builds call this. It takes a few seconds, and nothing if no source has
changed. Without a C compiler on the path it uses the one of the package ziglang, if that is there;
the libraries of another platform are always built by it.
"""

import argparse
import fcntl
import hashlib
import importlib.util
import io
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
HEADER = "_core_header.py"
"""The declarations of a library, beside it."""


@dataclass(frozen=True)
class Library:
    """One of the two libraries."""

    name: str
    own: tuple[str, ...]
    """Folders of the code whose public.h Python uses by this library, in order."""
    copied: tuple[str, ...] = ()
    """Folders of further code in it."""

    @property
    def file(self) -> str:
        """Its file's name, on all platforms."""
        return f"lib{self.name}.so"

    @property
    def folder(self) -> Path:
        """Its folder in the repository."""
        return HERE.parent / self.name / "core"

    @property
    def rooms(self) -> tuple[str, ...]:
        """All folders of its code."""
        return (*self.copied, *self.own)


_NETWORK = ("shared", "network", "impairments")
"""The network's code that both libraries have."""
NETEM = Library("netem", (*_NETWORK, "relay"))
NOACK = Library("noack", ("loop", "driver", "exact"), copied=_NETWORK)
LIBRARIES = {library.name: library for library in (NETEM, NOACK)}
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
_LIVE = ("shared/live_clock.c", "driver/driver.c", "driver/sockets.c", "driver/*tags.c", "relay/*.c")
"""Sockets and timers of live runs: only Linux has them. Elsewhere the libraries are without them."""
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


def sources(library: Library, target: str = OWN) -> list[Path]:
    """Return the C files of a platform's library, in a fixed order."""
    live = {file for pattern in _LIVE for file in HERE.glob(pattern)}
    return sorted({*_files(library.rooms, "c")} - (set() if "linux" in target else live))


def _files(rooms: Sequence[str], kind: str) -> list[Path]:
    return sorted(file for room in rooms for file in HERE.glob(f"{room}/*.{kind}"))


def declarations(library: Library) -> str:
    """Return what Python knows of a library: its public headers, and the function below."""
    headers = (HERE / room / "public.h" for room in library.own)
    own = "".join(header.read_text() for header in headers if header.exists())
    return f"{own}const char *{library.name}_sources(void);\n"


def is_current(
    library: Library, into: Path | None = None, files: Sequence[str] = (), target: str = OWN
) -> bool:
    """Return whether a folder has files of the present sources; by default its own, and both files."""
    digest = _digest(library, target).encode()
    paths = [(into or library.folder) / name for name in files or (library.file, HEADER)]
    return all(path.exists() and digest in path.read_bytes() for path in paths)


def build(
    library: Library,
    into: Path | None = None,
    *more_flags: str,
    library_alone: bool = False,
    target: str = OWN,
) -> bool:
    """Build library and declarations into a folder, by default its own; return whether any had changed.

    Each file is replaced as a whole, and one build waits for another. Both files contain the digest
    of the sources: the loader compares them. The declarations need cffi, the library does not.

    Raises:
        NoCompilerError: there is no C compiler.
        subprocess.CalledProcessError: the compiler reports a mistake.
    """
    into = into or library.folder
    into.mkdir(parents=True, exist_ok=True)
    folder = os.open(into, os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        files = [library.file] if library_alone else [library.file, HEADER]
        if not (missing := [name for name in files if not is_current(library, into, [name], target)]):
            return False
        for left in into.glob(f"{_SCRATCH}*"):  # by a build that was killed
            shutil.rmtree(left)
        with tempfile.TemporaryDirectory(prefix=_SCRATCH, dir=into) as name:
            scratch = Path(name)
            if library.file in missing:
                print(f"building {library.file} in C ...", flush=True)
                _compile(library, scratch, more_flags, target)
            if HEADER in missing:
                _write_declarations(library, scratch, target)
            for file in missing:
                (scratch / file).replace(into / file)
        for old in into.glob(f"__pycache__/{Path(HEADER).stem}.*"):  # maybe of the same second
            old.unlink(missing_ok=True)
        return True
    finally:
        os.close(folder)


def _compile(
    library: Library,
    into: Path,
    more_flags: tuple[str, ...],
    target: str = OWN,
    *,
    one_size: bool = False,
) -> None:
    """Compile a library; ``one_size`` leaves out the exact simulator's code of most sizes."""
    is_linux = "linux" in target
    command = [*compiler(target), *FLAGS, *more_flags]
    if is_linux:
        command.append("-fno-semantic-interposition")
    digest = into / "sources.c"
    digest.write_text(
        f'__attribute__((visibility("default"))) const char *{library.name}_sources(void);\n'
        f'const char *{library.name}_sources(void) {{ return "{_digest(library, target)}"; }}\n'
    )

    def compile_one(unit: tuple[int, tuple[Path, tuple[str, ...]]]) -> str:
        number, (file, own) = unit
        result = str(into / f"{file.stem}-{number}.o")
        subprocess.run([*command, *own, "-c", str(file), "-o", result], check=True)
        return result

    units = [
        (file, flags) for file, flags in _units(library, target)
        if file.name != _STATES or "-DN=4" in flags or not one_size
    ]  # fmt: skip
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        objects = [*pool.map(compile_one, enumerate([*units, (digest, ())]))]
    command += ["-shared", *objects, "-o", str(into / library.file)]
    if is_linux:  # its own calls go directly to its functions, not through a table
        command += ["-Wl,-Bsymbolic", "-lm"]
    elif target.startswith(("macosx", "darwin")):  # its name; otherwise it is its path
        command.append(f"-Wl,-install_name,{library.file}")
    subprocess.run(command, check=True)


def _units(library: Library, target: str) -> list[tuple[Path, tuple[str, ...]]]:
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
        *((states, flags) for flags in sizes if states.parent.name in library.rooms),
        *(
            (file, tags if file.name == _FOUR_TAGS else ())
            for file in sources(library, target)
            if file != states
        ),
    ]


def _write_declarations(library: Library, into: Path, target: str) -> None:
    path = into / HEADER
    with redirect_stdout(io.StringIO()):  # cffi prints its progress
        _declared(library).emit_python_code(str(path))
    digests = f"SOURCES = {_digest(library, target)!r}\nNETWORK = {_digest_of(_NETWORK)!r}\n"
    path.write_text(path.read_text() + digests)


def _declared(library: Library) -> Any:
    """Return the declarations of a library; the loop's have the types of the network's."""
    from cffi import FFI

    ffi = FFI()
    if library.copied:
        ffi.include(_declared(NETEM))
    ffi.cdef(declarations(library))
    ffi.set_source(f"{library.name}.core.{Path(HEADER).stem}", None)
    return ffi


def _digest(library: Library, target: str) -> str:
    """Return a digest of all that a library depends on."""
    return _digest_of(library.rooms, target)


def _digest_of(rooms: Sequence[str], target: str = "") -> str:
    digest = hashlib.blake2b(target.encode(), digest_size=16)
    for file in (*_files(rooms, "c"), *_files(rooms, "h"), Path(__file__)):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def main() -> int:
    """Build from the command line; print a line if something is built."""
    parser = argparse.ArgumentParser(description="Build the core in C.")
    parser.add_argument("library", choices=[*LIBRARIES], nargs="?", help="by default both")
    parser.add_argument("--into", type=Path, help="folder of a library, instead of its own")
    parser.add_argument("--check", action="store_true", help="compile without output; warnings are errors")
    parser.add_argument("--sanitized", action="store_true", help="with ASan and UBSan; needs --into")
    parser.add_argument("--library-alone", action="store_true", help="no declarations (cffi is not needed)")
    parser.add_argument("--platforms", action="store_true", help="print the platforms of the wheels")
    given = parser.parse_args()
    if given.platforms:
        print(*PLATFORMS)
        return 0
    libraries = [LIBRARIES[given.library]] if given.library else [*LIBRARIES.values()]
    if given.sanitized and not given.into:
        parser.error("--sanitized: noack cannot load this library; give another folder by --into")
    if given.into and not given.library:
        parser.error("--into: the declarations of both libraries have one name; say which: netem or noack")
    try:
        for library in libraries:
            if given.check:
                with tempfile.TemporaryDirectory() as scratch:
                    # In a fifth of the time. tests/native builds all with sanitizers, -Werror too.
                    _compile(library, Path(scratch), ("-Werror", "-O1"), one_size=True)
            else:
                flags = SANITIZERS if given.sanitized else ()
                build(library, given.into, *flags, library_alone=given.library_alone)
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
