"""The network emulator's process.

In a run it joins like every other process. On its own it serves any UDP program::

    python -m netem --listen 127.0.0.1:9000 --to 127.0.0.1:9001 --loss bernoulli:0.3 --mansd 4
"""

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import closing

from pydantic import TypeAdapter, ValidationError

from netem.link import Link, update_link_of
from netem.relay import Relay
from noack.clock import RunClock
from noack.errors import CallerError, ExitStatus
from noack.io.loop import run_loop
from noack.io.node import Node
from noack.io.process import add_options, join_run
from noack.io.signals import Signals
from noack.io.udp import bind, kernel_drops, parse_address, text_of
from noack.machine import Notice, Record
from noack.records import Fate
from noack.scenario import Loss

_LOSS_FORMS = {
    "lossless": (),
    "bernoulli": ("probability",),
    "gilbert_elliott": ("good_to_bad", "bad_to_good", "loss_in_good", "loss_in_bad"),
    "worst_case": (),
}


def main(arguments: Sequence[str] | None = None) -> ExitStatus:
    """Run the emulator: alone with ``--listen`` and ``--to``, else in a run."""
    parser = argparse.ArgumentParser(
        prog="noack netem",
        description="A UDP relay that loses datagrams, but never more than MANSD in a row per "
        "flow. Without --listen it joins the run that `noack record SCENARIO` has opened.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add_options(parser)
    alone = parser.add_argument_group("on its own")
    alone.add_argument("--listen", metavar="HOST:PORT", help="where datagrams come in")
    alone.add_argument("--to", metavar="HOST:PORT", help="where survivors go")
    alone.add_argument(
        "--loss",
        default="lossless",
        help="lossless, bernoulli:P, gilbert_elliott:P:R[:LOSS_GOOD[:LOSS_BAD]] or worst_case",
    )
    alone.add_argument("--mansd", type=int, help="at most so many successive drops per flow")
    alone.add_argument("--seed", type=int, default=0, help="seed of the losses")
    options = parser.parse_args(arguments)
    if (options.listen is None) != (options.to is None):
        parser.error("--listen and --to go together")
    if options.listen is None:
        for name in ("loss", "mansd", "seed"):
            if getattr(options, name) != parser.get_default(name):
                parser.error(f"--{name} is for an emulator on its own, with --listen and --to")
        return join_run("netem", _in_a_run, options)
    try:
        return _alone(options)
    except CallerError as error:
        print(f"noack netem: {error}", file=sys.stderr)
        return error.exit_status


def _in_a_run(node: Node) -> None:
    node.run(
        update_link_of(node.scenario),
        lambda endpoint, addresses: Relay(endpoint, addresses["controller"], addresses["sensor"]),
    )


def _alone(options: argparse.Namespace) -> ExitStatus:
    for name in ("mansd", "seed"):
        value = getattr(options, name)
        if value is not None and value < 0:
            raise CallerError(f"--{name} {value}: must be 0 or more")
    host, port = parse_address(options.listen, "--listen")
    destination = parse_address(options.to, "--to")
    link = Link(
        _parse_loss(options.loss),
        options.mansd,
        options.seed,
        "relay",
        first_delivered=options.mansd is not None,
    )
    fates = _Fates()
    with closing(bind(port, "netem", "--listen", host)) as endpoint:
        if destination == endpoint.getsockname():
            raise CallerError(f"--to {options.to}: leads back to --listen")
        listening = text_of(endpoint.getsockname())
        relay = Relay(endpoint, destination)
        with Signals().handled() as signals:
            # Said only now: before, a Ctrl-C would not yet have ended it well.
            ready = f"noack netem: {listening} → {options.to}, Ctrl-C ends"
            print(ready, file=sys.stderr, flush=True)
            run_loop(
                link,
                relay,
                RunClock(time.monotonic_ns()),
                fates,
                end_ns=None,
                stop=lambda: signals.received is not None,
            )
        report = fates.report() | {
            "send_errors": sum(relay.send_errors.values()),
            "lost_in_kernel": kernel_drops(endpoint),
        }
    print("noack netem: " + ", ".join(f"{n} {key}" for key, n in report.items()), file=sys.stderr)
    for what, n in relay.send_errors.items():
        print(f"noack netem: {n} datagrams could not be sent: {what}", file=sys.stderr)
    if options.json:
        print(json.dumps(report, indent=2))
    return ExitStatus.OK


def _parse_loss(text: str) -> Loss:
    model, *numbers = text.split(":")
    keys = _LOSS_FORMS.get(model)
    if keys is None or len(numbers) > len(keys):
        raise CallerError(f"--loss {text}: expected one of {', '.join(_LOSS_FORMS)}; see --help")
    try:
        settings = dict(zip(keys, map(float, numbers), strict=False))
        return TypeAdapter[Loss](Loss).validate_python({"model": model, **settings})
    except ValidationError as error:
        first = error.errors()[0]
        what = first["msg"].replace("Input should", "should")
        raise CallerError(f"--loss {text}: {first['loc'][-1]}: {what}") from None
    except ValueError:
        raise CallerError(f"--loss {text}: probabilities are numbers from 0 to 1") from None


class _Fates:
    """Counts fates instead of recording them."""

    def __init__(self) -> None:
        self._fates: Counter[Fate] = Counter()
        self._longest_run = 0

    def append(self, record: Record) -> None:
        """Count a datagram's fate."""
        _, _, _, _, _, fate, run, _, _ = record.row
        self._fates[fate] += 1
        self._longest_run = max(self._longest_run, run)

    def notice(self, notice: Notice) -> None:
        """Show a line."""
        print(notice.text, file=sys.stderr)

    def flush(self) -> None:
        """Nothing is gathered."""

    def report(self) -> dict[str, int]:
        """The counts."""
        counts = {fate.name.lower(): self._fates[fate] for fate in Fate}
        return counts | {"longest_drop_run": self._longest_run}


if __name__ == "__main__":
    sys.exit(main())
