"""The files of running emulators, by which commands find them.

While an emulator runs, its file is in the user's runtime directory
(:mod:`netem.core.private_folder`), beside the Unix socket on which it listens, which only its
user can reach.
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from netem.core import private_folder
from netem.core.command_line import netem_program
from netem.core.errors import CallerError, PeerError
from netem.core.private_folder import require_name

EMULATORS = "netem"
"""The folder of the files."""
_STARTING = "netem_starting"
"""The folder of the files of emulators that start."""


def _in_use(name: str) -> CallerError:
    return CallerError(f"--control {name}: an emulator of this name runs; choose another name")


@contextmanager
def registered_emulator(name: str, folder: str = EMULATORS) -> Iterator[Path]:
    """Keep an emulator's file within the context.

    Raises:
        CallerError: the name is not allowed or in use, or the folder is not the user's own.
    """
    require_name(name, "emulator")
    with ExitStack() as stack:
        try:
            path = stack.enter_context(private_folder.lock_file(folder, name, {}))
        except FileExistsError:
            raise _in_use(name) from None
        yield path


@contextmanager
def starting(name: str | None) -> Iterator[None]:
    """Publish within the context that an emulator of this name, if any, starts.

    Raises:
        CallerError: the name is not allowed or in use, or the folder is not the user's own.
    """
    if name is None:
        yield
        return
    with registered_emulator(name, _STARTING):
        if name in running_emulators():
            raise _in_use(name)
        yield


def running_emulators() -> list[str]:
    """Return the names of this user's emulators that accept commands.

    Raises:
        CallerError: other users have access to the folder.
    """
    return [file.path.stem for file in private_folder.live_lock_files(EMULATORS)]


@contextmanager
def emulator_folder(*, create: bool = False) -> Iterator[private_folder.PrivateFolder]:
    """Open the folder of the files, sockets and tokens of this user's emulators within the context.

    Raises:
        CallerError: the folder is not the user's own.
        FileNotFoundError: it does not exist, and ``create`` is false.
    """
    with private_folder.open_private(EMULATORS, create=create) as folder:
        yield folder


def socket_path(folder: private_folder.PrivateFolder, name: str) -> str:
    """Return the path of an emulator's socket for system calls.

    It may have at most 107 bytes, so it goes through the descriptor of the open folder.
    """
    return f"/proc/self/fd/{folder.descriptor}/{name}.sock"


def find_emulator(name: str | None) -> str:
    """Return the name of a running emulator; if ``name`` is None, of the only one.

    Raises:
        CallerError: there is no such emulator, or several run and none is named.
        PeerError: it is still starting.
    """
    registered = running_emulators()  # before the files of those that start: they have both for a moment
    starting_names = [file.path.stem for file in private_folder.live_lock_files(_STARTING)]
    files = [known for known in registered if known not in starting_names]
    if name not in files and (name in starting_names or (name is None and starting_names and not files)):
        raise PeerError(
            f"emulator {name or starting_names[0]!r} is starting; "
            "it prints `ready` on standard output when it accepts commands"
        )
    if not files:
        name_text = "" if name is None else f" {name!r}"
        raise CallerError(
            f"no emulator{name_text} accepts commands; start one with `{netem_program()} --control NAME …`"
        )
    if name is None and len(files) > 1:
        raise CallerError(f"which emulator? Running: {', '.join(files)}")
    name = name or files[0]
    if name not in files:
        raise CallerError(f"no emulator {name!r}; running: {', '.join(files)}")
    return name
