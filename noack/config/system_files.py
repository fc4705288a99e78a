"""Files that a plant is made of: an FMU, a Python source file.

They are not read into the scenario: a loaded one says where they are, and what their SHA-256 is,
without which nothing is run.
"""

from pathlib import Path

from noack.config.plant_systems import AnySystem, FmuSettings, PythonSettings
from noack.settings.named_file import NamedFile


def read_system(system: AnySystem, folder: Path, place: str) -> AnySystem:
    """Return settings in which a file is named absolutely, and its SHA-256 is given.

    A SHA-256 that stands there already is left alone, and so is its file until it is run: what a
    run recorded can be read without.

    Args:
        system: a plant's settings.
        folder: where relative names begin.
        place: where the settings stand, for messages.

    Raises:
        CallerError: there is no such file, or it cannot be read.
    """
    if not isinstance(system, FmuSettings | PythonSettings) or system.file is None:
        return system
    file = NamedFile(system.file, folder, place)
    sha256 = system.sha256 or file.sha256()
    return system.model_copy(update={"file": str(file.path.absolute()), "sha256": sha256})


def unchanged(system: FmuSettings | PythonSettings) -> Path:
    """Return where a loaded system's file is.

    Raises:
        CallerError: it is not the file that it was when the scenario was loaded, or is gone.
    """
    file = NamedFile(system.file or "", Path(), "plant.system")
    if (found := file.sha256()) != system.sha256:
        file.wrong(
            f"is not what it was: its SHA-256 is {found[:16]}..., "
            f"that of the run {(system.sha256 or 'not given')[:16]}..."
        )
    return file.path
