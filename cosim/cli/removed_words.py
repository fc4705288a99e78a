"""Commands and options that earlier builds had: who uses one is told the plain way instead."""

from collections.abc import Mapping, Sequence
from itertools import pairwise

REMOVED: Mapping[str, str] = {
    "archive": "zip the run directory",
    "capacity": "`noack campaign loops_on_a_link` varies the number of loops on a link",
    "collect": "copy the file that the process on the other host names, and `noack summary RUN --add FILE`",
    "fidelity": "`noack summary RUN` has the difference to the ideal loop",
    "helics": "send the federates' messages through `noack netem`, or use noack.VirtualNetwork",
    "paper": "`noack campaign paper` has the draws of Section V",
    "reproduce": "`noack simulate RUN` repeats a run, `noack replay RUN` compares its outputs",
    "design --for transmissions": "`--for network` for the scenario's mode; compare others by a campaign",
    "design --holds": "compare the modes by a campaign",
    "design --share": "compare event-triggered loops by a campaign",
    "design --window": "compare event-triggered loops by a campaign",
    "export --format fmu": "`noack netem` is a network between other programs",
    "measure --for-scenario": "`--for SCENARIO`",
    "measure --listen": "`irtt client -o FILE`, then `noack measure FILE`",
    "record --invitation": "the folder of credentials of `noack record --listen`",
    "record --invite": "the folder of credentials of `noack record --listen`",
    "record --metrics": "--log-format jsonl has the progress of a run",
    "record --valid-minutes": "the folder of credentials of `noack record --listen` is valid for its run",
    "run --hosts": "`noack record --listen`, and start each process on its host",
    "run --metrics": "--log-format jsonl has the progress of a run",
    **{
        f"{role} --invitation": f"`noack {role} --credentials FOLDER`"
        for role in ("plant", "sensor", "controller")
    },
}
"""The plain way by the words: a command, or a command and its option, perhaps with a value."""


def removal(command: str, option: str | None = None) -> str | None:
    """Return that a command or an option was removed, with the plain way; None if it never existed."""
    words = command if option is None else f"{command} {option}"
    return f"{words}: was removed; {REMOVED[words]}" if words in REMOVED else None


def removal_in(words: Sequence[str], option: str | None = None) -> str | None:
    """Return what :func:`removal` says of a command line that was refused.

    Args:
        words: the words of the command line; options may be before the command.
        option: the option that does not exist; None if another word was refused.
    """
    command = next((word for word in words if not word.startswith("-")), "")
    values = [f"{before} {word}" for before, word in pairwise(words)]
    values += [word.replace("=", " ", 1) for word in words if word.startswith("--")]
    lines = (removal(command, each) for each in (None, option, *values) if each != "")
    return next(filter(None, lines), None)
