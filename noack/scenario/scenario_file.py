"""Scenario files: a TOML file is read into a frozen scenario, with one line per mistake.

An entry of ``[[loops]]`` may name another scenario file; loading the scenario replaces the name by
tables. A loop takes that file's mode, model, plant, trigger, observer and controller. What the
loops of a run share is the run's: a file that sets it to something else is refused. Seeds, horizon,
speed, ports and real-time settings of the file have no effect.
"""

import copy
import re
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from os.path import commonprefix
from pathlib import Path

import tomli_w

from netem.core import toml_file
from netem.core.errors import CallerError, did_you_mean, printable, shortened
from netem.core.file_access import shipped_files
from netem.core.named_file import NamedFile
from netem.core.settings_section import ReadTable, ScenarioSection, Table
from netem.core.toml_file import keys as known_keys
from netem.core.toml_file import nearest_key
from netem.core.toml_limits import MOST_LEVELS
from noack.references.file import FilePiece
from noack.scenario.integrals import with_integrals
from noack.scenario.matrix_files import with_matrices
from noack.scenario.overload import refuse_overload
from noack.scenario.runtime_parameters import SHORT, full_key
from noack.scenario.scenario import LOOP_NEEDS, PARTS, Scenario, parts_model, with_loop_tables
from noack.scenario.scenario_checks import check_reference, check_target_loss
from noack.scenario.sections import DirectionSection, NetworkSection
from noack.scenario.symbols import SYMBOLS
from noack.settings.user_files import file_tables, with_absolute_path, with_tables

_ENTRY = r"""[-+\w.]+|"[^"\\\n]*\""""
_ROW = re.compile(rf"\[\n((?:\s*(?:{_ENTRY}),\n)+)\s*\]")
"""Rows of numbers or names; the TOML writer puts each entry on its own line."""
_OF_FILES = ("sha256", "t_s", "x", "u", "samples_s", "intervals_s", "times_ms", "sent_ns", "delays_ns")
"""What a loaded scenario has beside or instead of a file's name: the hash of a program, the numbers of
a reference, of delays, of outages, of a recording."""
REMOVED = "none"
"""The value of ``--set`` that removes a key; a text of these letters is written in quotes."""
_WITH_NONE = ("network.protocol",)
"""Keys of which none is a value."""
MOST_RECORDED_BYTES = 2**28
"""Largest size of a run's scenario file, which includes the losses and delays read from files."""


def load(
    path: Path,
    overrides: Iterable[str] = (),
    most_bytes: int = toml_file.MOST_BYTES,
    network: Path | None = None,
) -> Scenario:
    """Read and validate a scenario file.

    Args:
        path: the TOML file, or a run directory: its scenario has all that the run read from files.
        overrides: ``key=value`` settings that replace the file's, e.g. ``trigger.beta=0.3``.
        most_bytes: largest size of the file.
        network: a file whose table ``[network]`` replaces the scenario's, before the overrides.

    Raises:
        CallerError: one line per mistake, each with file (or ``--set``), key, value and remedy.
    """
    return load_with(path, settings_of(overrides), "--set ", most_bytes, network)


def load_with(
    path: Path,
    settings: Sequence[tuple[str, object]],
    named: str,
    most_bytes: int = toml_file.MOST_BYTES,
    network: Path | None = None,
) -> Scenario:
    """Read a scenario file, or that of a run directory, as :func:`load` does; for ``settings`` see below."""
    if (recorded := path / "scenario.toml").is_file():
        path, most_bytes = recorded, MOST_RECORDED_BYTES
    content = toml_file.read(path, Scenario, most_bytes)
    if network is not None:
        content["network"] = network_of(network)
    return completed_with(content, settings, path, named)


def network_of(path: Path) -> Table:
    """Return the table ``[network]`` of a TOML file, with absolute names of the files in it.

    `noack measure TRACE --write FILE` writes such a file; a scenario file has one, too.

    Raises:
        CallerError: the file cannot be read, or has no such table, or a wrong one.
    """
    table = toml_file.read(path, Scenario).get("network")
    if not isinstance(table, dict):
        raise CallerError(f"{path}: no table [network]; `noack measure TRACE --write FILE.toml` writes one")
    section = toml_file.validated(NetworkSection, table, f"{path}: network")
    for place, direction in section.directions.items():
        _direction_contents(direction, path.parent, f"{path}: {place}")
    folder = path.absolute().parent
    return with_file_names(table, lambda name: str(folder / name))


def with_file_names(table: ReadTable, rename: Callable[[str], str]) -> Table:
    """Return a table of a network with other names of files, which are its keys ``file``, at any depth."""

    def renamed(key: str, value: object) -> object:
        if isinstance(value, dict):
            return with_file_names(value, rename)
        if isinstance(value, list):
            return [renamed("", entry) for entry in value]
        return rename(value) if key == "file" and isinstance(value, str) else value

    return {key: renamed(key, value) for key, value in table.items()}


def completed_with(
    content: Table, settings: Sequence[tuple[str, object]], path: Path, named: str
) -> Scenario:
    """Validate parsed content, as :func:`completed` does, after values in it are replaced.

    Args:
        content: as parsed; it is changed.
        settings: keys, which may be short, and their values; None removes a key.
        path: the scenario file.
        named: what stands before a key in a message about a setting: ``--set`` or ``settings:``.

    Raises:
        CallerError: one line per mistake, each with file or ``named``, key, value and remedy.
    """
    given = copy.deepcopy(content) if settings else content
    # A hash comes after its file's name, which removes that of the old file.
    for key, value in sorted(settings, key=lambda setting: setting[0].endswith(".sha256")):
        put(content, key, value, f"{named}{key}")
    try:
        return completed(content, path)
    except CallerError as error:
        lines, keys = str(error), [full_key(key) for key, _ in settings]
        for key, (_, value) in zip(keys, settings, strict=True):
            lines = _explain_kind(lines, path, key, value, named)
        raise CallerError(_attributed(lines, path, keys, given, named) if keys else lines) from None


def completed(content: ReadTable, path: Path, source: str | None = None) -> Scenario:
    """Validate parsed content and read the files that it names, relative to the scenario file.

    Files of matrices and those of the loops are read before the validation, since they are part of what
    is validated; those of losses, delays and references after it. The names of users' programs become
    absolute; a link that must overflow is refused.

    ``source`` (by default the path) names the content in error messages: CallerError has one line
    per mistake.
    """
    source = source or str(path)
    if "axes" in content and "model" not in content:
        raise CallerError(f"{source}: a campaign, not a scenario; `noack campaign` runs it")
    if "link" in content and "model" not in content:
        raise CallerError(f"{source}: a file of links, not a scenario; `noack netem --links` takes it")
    if content.keys().isdisjoint(("loops", *LOOP_NEEDS)):
        raise CallerError(f"{source}: not a scenario: {', '.join(LOOP_NEEDS)} are missing")
    content = with_integrals(with_matrices(content, path.parent, source), source)
    content = with_named_scenarios(content, path.parent, source)
    return _with_contents_of_files(validate(content, source), path, source)


def validate(content: ReadTable, source: str) -> Scenario:
    """Validate parsed content; raise CallerError with one line per mistake, named by ``source``."""
    return toml_file.validated(Scenario, content, source)


def _with_contents_of_files(scenario: Scenario, path: Path, source: str) -> Scenario:
    """Return a valid scenario with the contents of the files that it still names, or their absolute names."""
    network = scenario.network
    update: dict[str, object] = {}
    for place, section in network.directions.items():
        read = _direction_contents(section, path.parent, f"{source}: {place}")
        _, _, key = place.partition(".")
        update |= {key: section.model_copy(update=read)} if key else read
    scenario = scenario.model_copy(update={"network": network.model_copy(update=update)})
    try:
        check_target_loss(scenario)
    except ValueError as error:
        raise CallerError(f"{source}: {error}") from None

    def tables(within: str, loop: Scenario) -> dict[str, ScenarioSection]:
        read = {
            place: with_absolute_path(table, path.parent, f"{source}: {within}{place}")
            for place, table in file_tables(loop)
        }
        return {**read, **_with_reference(loop, path.parent, f"{source}: {within}")}

    scenario = with_tables(scenario, tables("", scenario))
    scenario = with_loop_tables(scenario, lambda place, loop: tables(f"{place}.", loop))
    try:
        refuse_overload(scenario)
    except ValueError as error:
        raise CallerError(f"{source}: {error}") from None
    return scenario


def _with_reference(loop: Scenario, folder: Path, place: str) -> dict[str, ScenarioSection]:
    """Return the controller with the numbers of the file that its reference names, if it names one."""
    controller = loop.controller
    piece = (controller.reference or (None,))[0]
    if not isinstance(piece, FilePiece) or piece.file is None:
        return {}
    file = NamedFile(piece.file, folder, f"{place}controller.reference.0")
    read = controller.model_copy(update={"reference": (piece.read(file, *loop.entry_names),)})
    try:
        check_reference(loop.model_copy(update={"controller": read}))
    except ValueError as error:
        file.wrong(str(error).removeprefix("controller.reference.0."))
    return {"controller": read}


def _direction_contents(section: DirectionSection, folder: Path, place: str) -> Table:
    """Return the loss and the impairments of a direction with the contents of their files."""
    impairments = tuple(
        impairment.without_files(folder, f"{place}.impairments.{number}")
        for number, impairment in enumerate(section.impairments)
    )
    return {"loss": section.loss.without_files(folder, f"{place}.loss"), "impairments": impairments}


def with_named_scenarios(content: ReadTable, folder: Path, source: str) -> ReadTable:
    """Return a scenario's content with the tables of the files that its loops name.

    Names are relative to ``folder``, or those of shipped scenarios. If every loop has a file, and
    the top level nothing of what a loop needs, it gets the tables of the first one, which no loop
    uses. Raise CallerError, with one line per mistake, if a file is no scenario of one loop.
    """
    if not isinstance(loops := content.get("loops"), list):
        return content
    entries = []
    for index, entry in enumerate(loops):
        tables = {}
        if isinstance(entry, dict) and isinstance(name := entry.get("scenario"), str):
            setting = printable(f'{source}: loops.{index}.scenario = "{name}"')
            tables = {"scenario": _loop_tables(_path(name, folder, setting), setting)}
        entries.append(entry | tables if tables else entry)
    files = [entry["scenario"] for entry in entries if isinstance(entry, dict) and "scenario" in entry]
    if len(files) == len(entries) and content.keys().isdisjoint(LOOP_NEEDS):
        content = {**next(filter(None, files), {}), **content}
    return {**content, "loops": entries}


def _loop_tables(path: Path, setting: str) -> Table:
    """Return the tables of a loop's file, which the key ``setting`` names."""
    content = toml_file.read(path, Scenario)
    if content.get("loops"):
        raise CallerError(f"{setting}: that file has loops itself; name a file of one loop")
    filled = with_integrals(with_matrices(content, path.parent, str(path)), str(path))
    file = toml_file.validated(parts_model(frozenset(PARTS), others_optional=True), filled, str(path))
    tables = {
        place: with_absolute_path(table, path.parent, f"{path}: {place}")
        for place, table in file_tables(file)
    }
    parts = set(PARTS)
    return with_tables(file, tables).model_dump(mode="json", exclude_none=True, include=parts)


def _path(name: str, folder: Path, setting: str) -> Path:
    """Return the path of a file, or of the shipped scenario of that name."""
    shipped = shipped_files("scenarios")
    with suppress(OSError, ValueError):  # too long, or with a zero byte
        if name and (path := folder / name).exists():
            return path
    if name in shipped:
        return shipped[name]
    names = [*shipped, *sorted(file.name for file in folder.glob("*.toml"))]
    hint = did_you_mean(name, names) or "`noack scenarios` lists the shipped ones"
    raise CallerError(f"{setting}: no such file, nor a shipped scenario; {hint}")


def dumps(scenario: Scenario) -> str:
    """Return the scenario as TOML that :func:`load` reads back to an equal scenario."""
    return toml_text(scenario.content())


def toml_text(content: ReadTable) -> str:
    """Return tables as TOML, with each row of numbers or names on one line."""
    text = tomli_w.dumps(content, indent=2)
    return _ROW.sub(lambda row: f"[{', '.join(re.findall(_ENTRY, row[1]))}]", text)


def _explain_kind(lines: str, path: Path, key: str, value: object, named: str) -> str:
    """Make one line of all mistakes that arise because only the kind of a table was set."""
    table, _, kind = key.rpartition(".")
    start = re.escape(printable(f"{path}: {table}."))
    unknown = re.findall(rf"^{start}(\w+) = .*: unknown key; .*", lines, re.MULTILINE)
    if kind not in ("kind", "model", "policy") or not unknown:
        return lines
    missing = re.findall(rf"^{start}(\w+): missing.*", lines, re.MULTILINE)
    other_lines = re.sub(rf"^{start}\w+(: missing| = .*: unknown key; ).*\n?", "", lines, flags=re.MULTILINE)
    assignments = "".join(f", {name}=..." for name in missing)
    line = (
        f"{named}{table}.{kind} = {value}: the file has {', '.join(unknown)} of another {kind}; "
        f"set the table: {named}'{table}={{{kind}=\"{value}\"{assignments}}}'"
    )
    return "\n".join([line, *other_lines.splitlines()])


def _attributed(lines: str, path: Path, keys: Sequence[str], given: ReadTable, named: str) -> str:
    """Name the settings if a key that was set is wrong, or if the content without them is valid."""
    is_valid_alone = False
    with suppress(CallerError):
        completed(given, path)
        is_valid_alone = True
    names = [shortened(key) for key in keys]

    def attributed(line: re.Match[str]) -> str:
        assignment, _, hint = line["rest"].rpartition(": unknown key; ")
        for name in names:  # an unknown section: the whole name may be similar to a key
            section, dot, _ = name.partition(".")
            if assignment.startswith(f"{section} = "):
                nearest_name = nearest_key(name, (*SHORT, *known_keys(Scenario)))
                if nearest_name and section not in SYMBOLS:
                    hint = f"did you mean {nearest_name}?"
                return f"{named}{name if dot else assignment}: unknown key; {hint}"
        if any(re.match(rf"{re.escape(name)}[.:=\s]", line["rest"]) for name in names):
            return f"{named}{line['rest']}"
        if not is_valid_alone:
            return line[0]
        place = re.split(r"[:\s]", line["rest"], maxsplit=1)[0].split(".")
        # The number of equal parts at the beginning of two keys.
        shared = [len(commonprefix([place, key.split(".")])) for key in keys]  # noqa: RUF071
        nearest = [name for name, parts in zip(names, shared, strict=True) if parts == max(shared)]
        return f"{line['file']} with {named}{', '.join(nearest)}: {line['rest']}"

    file = re.escape(printable(str(path)))
    return re.sub(rf"^(?P<file>{file}): (?P<rest>.*)", attributed, lines, flags=re.MULTILINE)


def settings_of(overrides: Iterable[str], example: str = "trigger.beta=0.3") -> list[tuple[str, object]]:
    """Return keys and values of ``--set KEY=VALUE``; the value None, of ``KEY=none``, removes a key.

    Raises:
        CallerError: a setting is written otherwise.
    """
    return [_setting_of(override, example) for override in overrides]


def require_keys_once(overrides: Sequence[str]) -> None:
    """Raise CallerError if a command line sets a key twice."""
    keys = [full_key(override.partition("=")[0].strip()) for override in overrides]
    if repeated := [key for key in keys if keys.count(key) > 1]:
        raise CallerError(f"--set {shortened(printable(repeated[0]))}: is given twice")


def _setting_of(override: str, example: str) -> tuple[str, object]:
    key, equals, text = override.partition("=")
    if not equals or not key.strip():
        excerpt = shortened(printable(override))
        raise CallerError(f"--set {excerpt}: write it as key=value, e.g. {example}")
    is_removed = text.strip() == REMOVED and full_key(key.strip()) not in _WITH_NONE
    return key.strip(), None if is_removed else value_of(text, f"--set {key}")


def value_of(text: str, source: str) -> object:
    """Return the value of a text on the command line; a bare word is a string.

    Raise CallerError if the text is not a TOML value; ``source`` names it.
    """
    try:
        return toml_file.parsed(f"value = {text}", source)["value"]
    except CallerError:
        if text.lstrip()[:1] in tuple("{[\"'") or text.strip().isdecimal():
            raise
        return text


def put(content: Table, key: str, value: object, source: str) -> None:
    """Set the value of a key such as ``trigger.beta``, which may be short; None removes the key.

    Missing tables are created. With the name of a file, what is there of another one is removed: its
    hash, or its numbers. An entry of a list is named by its number: ``network.impairments.0.rate_bps``.

    Raises:
        CallerError: a part of the key is a value, not a table; a list has no such entry; or the key
            has too many parts.
    """
    table: object = content
    *path, last = full_key(key).split(".")
    if value is None:
        _remove(content, full_key(key), source)
        return
    if len(path) >= MOST_LEVELS:
        raise CallerError(f"{source}: the key has more than {MOST_LEVELS} parts")
    for depth, part in enumerate(path):
        if isinstance(table, dict):
            table = table.setdefault(part, {})
        else:
            entries, number = _list_entry(table, part, f"{source}: {'.'.join(path[:depth])}")
            table = entries[number]
    if isinstance(table, dict):
        _forget_file(table, last)
        table[last] = copy.deepcopy(value)
    else:
        entries, number = _list_entry(table, last, f"{source}: {'.'.join(path)}")
        entries[number] = copy.deepcopy(value)


def _remove(content: Table, key: str, source: str) -> None:
    """Remove a key, or an entry of a list; it need not be there, but a scenario must know it.

    Raises:
        CallerError: no scenario has such a key.
    """
    table: object = content
    *path, last = key.split(".")
    for part in path:
        if isinstance(table, list) and part.isdecimal():
            table = table[int(part)] if int(part) < len(table) else None
        else:
            table = table.get(part) if isinstance(table, dict) else None
    if isinstance(table, list):
        entries, number = _list_entry(table, last, f"{source}: {'.'.join(path)}")
        del entries[number]
    elif isinstance(table, dict) and last in table:
        _forget_file(table, last)
        del table[last]
    elif path[:1] != ["loops"]:
        _require_known(key, source)


def _require_known(key: str, source: str) -> None:
    """Raise CallerError unless this is a key or a table of a scenario."""
    known = known_keys(Scenario)
    if not any(f"{each}.".startswith(f"{key}.") for each in known):
        nearest = nearest_key(key, (*SHORT, *known))
        hint = f"did you mean {nearest}?" if nearest else "`noack check` prints a scenario's keys"
        raise CallerError(printable(f"{source}: unknown key; {hint}"))


def _forget_file(table: Table, key: str) -> None:
    """Remove what a loaded scenario has of a file, if ``key`` is that of its name."""
    for read in _OF_FILES if key == "file" else ():
        table.pop(read, None)


def _list_entry(table: object, part: str, source: str) -> tuple[list[object], int]:
    """Return a list and the number of its entry that a part of a key names."""
    if not isinstance(table, list):
        raise CallerError(printable(f"{source} is not a table"))
    if part.isdecimal() and int(part) < len(table):
        return table, int(part)
    entries = f"the entries 0 to {len(table) - 1}" if table else "no entries"
    raise CallerError(printable(f"{source} has {entries}, not {part}"))
