"""An example of each word, for those who are looking for it."""

from collections.abc import Mapping, Sequence

from noack.core.errors import CallerError

EXAMPLES: Mapping[str, str] = {
    "loss": "loss 30%",
    "drop": "loss 30%",
    "random": "loss 30%",
    "gemodel": "loss gemodel 1% 10%",
    "state": "loss state 1% 10%",
    "burst": "loss burst 5% 3",
    "periodic": "loss periodic 2/100",
    "script": "loss script 3,4,17",
    "trace": "loss trace FILE",
    "worst": "loss worst mansd 4",
    "delay": "delay 10ms",
    "latency": "delay 10ms",
    "jitter": "delay 10ms 2ms",
    "distribution": "delay 10ms 2ms distribution normal",
    "samples": "delay 0s samples 1ms,2ms,10ms",
    "lossrel": "loss 5% delay 10ms 2ms lossrel 50%",
    "duplicate": "duplicate 1%",
    "corrupt": "corrupt 1%",
    "reorder": "delay 10ms reorder 5%",
    "gap": "delay 10ms gap 5",
    "rate": "rate 1mbit",
    "queue": "rate 1mbit queue 20",
    "blackout": "blackout 2s-3s",
    "mansd": "mansd 4",
    "first": "first",
    "limit": "limit 1000",
}
"""By the word; ``seed`` is an option, too, and so not here."""


def require_no_dashes(arguments: Sequence[str]) -> None:
    """Require that no word stands there as an option.

    Raises:
        CallerError: one does.
    """
    for argument in arguments:
        word = argument.lstrip("-").partition("=")[0]
        if argument.startswith("-") and word in EXAMPLES:
            raise CallerError(f"{argument}: words stand without the dashes, e.g. {EXAMPLES[word]}")
