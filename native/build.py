"""Builds the core: a shared library of native/*.c, and the declarations of noack.h for cffi.

``make setup`` and the wheel's build call it. It takes a few seconds, and nothing if no source has
changed. Without a C compiler on the path it uses the one of the package ziglang, if that is there.
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
import sysconfig
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import redirect_stdout
from pathlib import Path

HERE = Path(__file__).resolve().parent
INTO = HERE.parent / "noack" / "core"
LIBRARY, HEADER = "libnoack.so", "_core_header.py"
_SCRATCH = ".building-"
_STATES = "states.c"
"""The exact simulator's code for a fixed number of states; it is compiled for each of these:"""
_SIZES = (64, 16, 8, 4, 3)
_FUSED = ("-DFUSED", "-mavx2", "-mfma")
# The vectors stay 256 bits wide: twice as many registers are what speeds the code up.
_WIDE = (
    "-DWIDE", "-mavx512f", "-mavx512vl", "-mavx512dq", "-mprefer-vector-width=256",
)  # fmt: skip
NO_COMPILER = 3
"""Exit status if there is no C compiler."""
# No contraction of a·b + c: results have the same bits on every processor.
FLAGS = (
    "-std=c11", "-O3", "-fPIC", "-fvisibility=hidden", "-ffp-contract=off",
    "-fno-math-errno", "-fno-semantic-interposition", "-g0", "-Wall", "-Wextra", "-Wconversion",
)  # fmt: skip
SANITIZERS = (
    "-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all", "-g",
    "-Werror", "-O1",
)  # fmt: skip


class NoCompilerError(Exception):
    """There is no C compiler."""


def compiler() -> list[str]:
    """Return the command of a C compiler: $CC, cc, gcc or clang, or that of ziglang.

    Raises:
        NoCompilerError: there is none.
    """
    if os.environ.get("CC"):
        return shlex.split(os.environ["CC"])
    for name in ("cc", "gcc", "clang"):
        if shutil.which(name):
            return [name]
    if importlib.util.find_spec("ziglang"):
        # Not for this machine's processor only, as the other compilers do it.
        return [sys.executable, "-m", "ziglang", "cc", "-mcpu=baseline"]
    raise NoCompilerError(
        "noack's core needs a C compiler: install gcc or clang (Debian: apt-get install gcc "
        "libc6-dev), or the Python package ziglang"
    )


def sources() -> list[Path]:
    """Return the C files of the core, in a fixed order."""
    return sorted(HERE.glob("**/*.c"))


def declarations() -> str:
    """Return what Python knows of the library: the text of noack.h, and the function below."""
    return (HERE / "noack.h").read_text() + "const char *noack_sources(void);\n"


def is_current(into: Path = INTO, files: Sequence[str] = (LIBRARY, HEADER)) -> bool:
    """Return whether a folder has files of the present sources."""
    digest = _digest().encode()
    paths = [into / name for name in files]
    return all(path.exists() and digest in path.read_bytes() for path in paths)


def build(into: Path = INTO, *more_flags: str, library_alone: bool = False) -> bool:
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
        if not (missing := [name for name in files if not is_current(into, [name])]):
            return False
        for left in into.glob(f"{_SCRATCH}*"):  # by a build that was killed
            shutil.rmtree(left)
        with tempfile.TemporaryDirectory(prefix=_SCRATCH, dir=into) as name:
            scratch = Path(name)
            if LIBRARY in missing:
                print("building the core in C ...", flush=True)
                _compile(scratch, more_flags)
            if HEADER in missing:
                _write_declarations(scratch)
            for file in missing:
                (scratch / file).replace(into / file)
        for old in into.glob(f"__pycache__/{Path(HEADER).stem}.*"):  # maybe of the same second
            old.unlink(missing_ok=True)
        return True
    finally:
        os.close(folder)


def _compile(into: Path, more_flags: tuple[str, ...]) -> None:
    command = compiler()
    digest = into / "sources.c"
    digest.write_text(
        '__attribute__((visibility("default"))) const char *noack_sources(void);\n'
        f'const char *noack_sources(void) {{ return "{_digest()}"; }}\n'
    )

    def compile_one(unit: tuple[int, tuple[Path, tuple[str, ...]]]) -> str:
        number, (file, own) = unit
        result = str(into / f"{file.stem}-{number}.o")
        subprocess.run(
            [*command, *FLAGS, *own, *more_flags, "-c", str(file), "-o", result], check=True
        )
        return result

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        objects = [*pool.map(compile_one, enumerate([*_units(), (digest, ())]))]
    library = str(into / LIBRARY)
    # The core's own calls go directly to its functions, not through a table.
    command += [*FLAGS, *more_flags, "-shared", "-Wl,-Bsymbolic", *objects, "-lm", "-o", library]
    subprocess.run(command, check=True)


def _units() -> list[tuple[Path, tuple[str, ...]]]:
    """Return the files to compile, each with its own flags; those that take longest are first."""
    states = HERE / "exact" / _STATES
    sizes: list[tuple[str, ...]] = [(f"-DN={size}",) for size in _SIZES]
    if platform.machine() in ("x86_64", "AMD64"):  # three sizes without AVX2 and FMA
        fused = [(*size, *_FUSED) for size in sizes]
        wide = [(size, *_FUSED, *_WIDE) for size in ("-DN=8", "-DN=4")]
        sizes = [*fused, *wide, ("-DN=64",), ("-DN=4",), ("-DN=3",)]
    return [
        *((states, flags) for flags in sizes),
        *((file, ()) for file in sources() if file != states),
    ]


def _write_declarations(into: Path) -> None:
    from cffi import FFI

    ffi = FFI()
    ffi.cdef(declarations())
    ffi.set_source("noack.core._core_header", None)
    path = into / HEADER
    with redirect_stdout(io.StringIO()):  # it says what it does
        ffi.emit_python_code(str(path))
    path.write_text(f"{path.read_text()}SOURCES = {_digest()!r}\n")


def _digest() -> str:
    """Return a digest of all that the library depends on."""
    digest = hashlib.blake2b(sysconfig.get_platform().encode(), digest_size=16)
    for file in (*sources(), *sorted(HERE.glob("**/*.h")), Path(__file__)):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def main() -> int:
    """Build from the command line; print a line if something is built."""
    parser = argparse.ArgumentParser(description="Build the core in C.")
    parser.add_argument("--into", type=Path, default=INTO, help="folder of the library")
    parser.add_argument("--check", action="store_true", help="only look: a warning is an error")
    parser.add_argument(
        "--sanitized", action="store_true", help="with ASan and UBSan; needs --into"
    )
    parser.add_argument(
        "--library", action="store_true", help="only the library: before cffi is installed"
    )
    given = parser.parse_args()
    if given.sanitized and given.into == INTO:
        parser.error("--sanitized: noack cannot load this library; give another folder by --into")
    try:
        if given.check:
            with tempfile.TemporaryDirectory() as scratch:
                _compile(Path(scratch), ("-Werror",))
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
