"""Builds the core: a shared library of native/*.c, and the declarations of noack.h for cffi.

``make setup`` and the wheel's build call it. It takes a few seconds, and nothing if no source has
changed. Without a C compiler on the path it uses the one of the package ziglang, if that is there.
"""

import argparse
import hashlib
import importlib.util
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
INTO = HERE.parent / "noack" / "core"
LIBRARY, HEADER = "libnoack.so", "_core_header.py"
# No contraction of a·b + c: results have the same bits on every processor.
FLAGS = (
    "-std=c11", "-O3", "-fPIC", "-shared", "-fvisibility=hidden", "-ffp-contract=off",
    "-fno-math-errno", "-Wall", "-Wextra",
)  # fmt: skip
SANITIZERS = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-g", "-Werror")


def compiler() -> list[str]:
    """Return the command of a C compiler: $CC, cc, gcc or clang, or that of ziglang.

    Raises:
        SystemExit: there is none.
    """
    if os.environ.get("CC"):
        return shlex.split(os.environ["CC"])
    for name in ("cc", "gcc", "clang"):
        if shutil.which(name):
            return [name]
    if importlib.util.find_spec("ziglang"):
        return [sys.executable, "-m", "ziglang", "cc"]
    sys.exit("native/build.py: no C compiler; install gcc or clang, or: pip install ziglang")


def sources() -> list[Path]:
    """Return the C files of the core, in a fixed order."""
    return sorted(HERE.glob("**/*.c"))


def declarations() -> str:
    """Return the text of noack.h."""
    return (HERE / "noack.h").read_text()


def build(into: Path = INTO, sanitized: bool = False) -> bool:
    """Build library and declarations into a folder; return whether anything had changed."""
    digest = _digest(sanitized)
    header = into / HEADER
    if (into / LIBRARY).exists() and header.exists() and digest in header.read_text():
        return False
    with tempfile.TemporaryDirectory(dir=into) as scratch:
        library, code = Path(scratch) / LIBRARY, Path(scratch) / HEADER
        more = SANITIZERS if sanitized else ()
        subprocess.run(
            [*compiler(), *FLAGS, *more, *map(str, sources()), "-lm", "-o", str(library)],
            check=True,
        )
        _write_declarations(code)
        code.write_text(f"{code.read_text()}SOURCES = {digest!r}\n")
        library.replace(into / LIBRARY)
        code.replace(header)
    return True


def _write_declarations(path: Path) -> None:
    from cffi import FFI

    ffi = FFI()
    ffi.cdef(declarations())
    ffi.set_source("noack.core._core_header", None)
    ffi.emit_python_code(str(path))


def _digest(sanitized: bool) -> str:
    digest = hashlib.blake2b(digest_size=16)
    for file in (*sources(), *sorted(HERE.glob("*.h")), Path(__file__)):
        digest.update(file.read_bytes())
    return digest.hexdigest() + ("-sanitized" if sanitized else "")


def main() -> None:
    """Build from the command line."""
    parser = argparse.ArgumentParser(description="Build the core in C.")
    parser.add_argument("--into", type=Path, default=INTO, help="folder of the library")
    parser.add_argument("--sanitized", action="store_true", help="with ASan and UBSan")
    given = parser.parse_args()
    try:
        changed = build(given.into, given.sanitized)
    except subprocess.CalledProcessError as error:
        sys.exit(error.returncode)
    print(f"{given.into / LIBRARY}: {'built' if changed else 'is current'}")


if __name__ == "__main__":
    main()
