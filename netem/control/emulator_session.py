"""Session files: the running emulators of this user.

While an emulator runs, its file is in the user's runtime directory
(:mod:`noack.runtime.private_folder`), beside its socket.
"""

from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path

from noack.core.errors import CallerError, PeerError
from noack.runtime import private_folder
from noack.runtime.private_folder import require_name

EMULATORS = "netem"
"""The folder of the files."""
_STARTING = "netem_starting"


def _in_use(name: str) -> CallerError:
    return CallerError(f"--control {name}: an emulator of this name runs; choose another name")


@contextmanager
def _locked(kind: str, name: str) -> Iterator[Path]:
    require_name(name, "emulator")
    with ExitStack() as stack:
        try:
            path = stack.enter_context(private_folder.lock_file(kind, name, {}))
        except FileExistsError:
            raise _in_use(name) from None
        yield path


def published(name: str) -> AbstractContextManager[Path]:
    """Keep an emulator's file within the context.

    Raises:
        CallerError: the name is not allowed or in use, or the folder is not the user's own.
    """
    return _locked(EMULATORS, name)


@contextmanager
def starting(name: str | None) -> Iterator[None]:
    """Publish within the context that an emulator of this name, if any, starts.

    Raises:
        CallerError: the name is not allowed or in use, or the folder is not the user's own.
    """
    if name is None:
        yield
        return
    with _locked(_STARTING, name):
        if name in running():
            raise _in_use(name)
        yield


def running() -> list[str]:
    """Return the names of this user's emulators that accept commands.

    Raises:
        CallerError: other users have access to the folder.
    """
    return list(_files())


def find(name: str | None) -> str:
    """Return the name of a running emulator; if ``name`` is None, of the only one.

    Raises:
        CallerError: there is no such emulator, or several run and none is named.
        PeerError: it is still starting.
    """
    files = _files()
    begun = [file.path.stem for file in private_folder.live_lock_files(_STARTING)]
    if name not in files and (name in begun or (name is None and begun and not files)):
        raise PeerError(
            f"emulator {name or begun[0]!r} is starting; "
            "it prints `ready` on standard output when it accepts commands"
        )
    if not files:
        which = "" if name is None else f" {name!r}"
        raise CallerError(
            f"no emulator{which} accepts commands; start one with `noack netem --control NAME …`"
        )
    if name is None and len(files) > 1:
        raise CallerError(f"which emulator? Running: {', '.join(files)}")
    name = name or next(iter(files))
    if name not in files:
        raise CallerError(f"no emulator {name!r}; running: {', '.join(files)}")
    return name


def _files() -> dict[str, private_folder.LockFile]:
    return {file.path.stem: file for file in private_folder.live_lock_files(EMULATORS)}
