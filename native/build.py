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
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from concurrent.futures import ThreadPoolExecutor
from contextlib import redirect_stdout
from pathlib import Path

HERE = Path(__file__).resolve().parent
INTO = HERE.parent / "noack" / "core"
LIBRARY, HEADER = "libnoack.so", "_core_header.py"
_SCRATCH = ".building-"
_SIZES = "sizes"
"""Folder of the files that take the longest; they are begun first."""
NO_COMPILER = 3
"""Exit status if there is no C compiler."""
# No contraction of a·b + c: results have the same bits on every processor.
FLAGS = (
    "-std=c11", "-O3", "-fPIC", "-fvisibility=hidden", "-ffp-contract=off",
    "-fno-math-errno", "-g0", "-Wall", "-Wextra", "-Wconversion",
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


def is_current(into: Path = INTO) -> bool:
    """Return whether a folder has library and declarations of the present sources."""
    library, header, digest = into / LIBRARY, into / HEADER, _digest().encode()
    return all(file.exists() and digest in file.read_bytes() for file in (library, header))


def build(into: Path = INTO, *more_flags: str) -> bool:
    """Build library and declarations into a folder; return whether anything had changed.

    Each file is replaced as a whole, and one build waits for another. Both files contain the digest
    of the sources: the loader compares them.

    Raises:
        NoCompilerError: there is no C compiler.
        subprocess.CalledProcessError: the compiler reports a mistake.
    """
    into.mkdir(parents=True, exist_ok=True)
    folder = os.open(into, os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        if is_current(into):
            return False
        for left in into.glob(f"{_SCRATCH}*"):  # by a build that was killed
            shutil.rmtree(left)
        with tempfile.TemporaryDirectory(prefix=_SCRATCH, dir=into) as name:
            scratch = Path(name)
            print("building the core in C ...", flush=True)
            _compile(scratch, more_flags)
            _write_declarations(scratch)
            (scratch / LIBRARY).replace(into / LIBRARY)
            (scratch / HEADER).replace(into / HEADER)
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

    def compile_one(file: Path) -> str:
        result = into / "-".join(file.with_suffix(".o").parts[-3:])
        # Code for a fixed number of states takes half the time to compile, and as long to run.
        flags = [*FLAGS, *(("-O2",) if file.parent.name == _SIZES else ()), *more_flags]
        subprocess.run([*command, *flags, "-c", str(file), "-o", str(result)], check=True)
        return str(result)

    files = sorted((*sources(), digest), key=lambda file: file.parent.name != _SIZES)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        objects = [*pool.map(compile_one, files)]
    library = str(into / LIBRARY)
    command += [*FLAGS, *more_flags, "-shared", *objects, "-lm", "-o", library]
    subprocess.run(command, check=True)


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
    given = parser.parse_args()
    if given.sanitized and given.into == INTO:
        parser.error("--sanitized: noack cannot load this library; give another folder by --into")
    try:
        if given.check:
            with tempfile.TemporaryDirectory() as scratch:
                _compile(Path(scratch), ("-Werror",))
        else:
            build(given.into, *(SANITIZERS if given.sanitized else ()))
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
