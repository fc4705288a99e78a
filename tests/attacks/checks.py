"""Checks of a run under attack; each check yields one line per failure."""

from collections.abc import Callable, Iterator, Mapping

from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    NETEM_PACKET,
    PLANT_ACTUATION,
    SENSOR_MEASUREMENT,
)
from noack.protocol.topology import LOOP_ROLES, RECEIVES, sender_to
from noack.runtime.udp_sockets import SHED
from tests.attacks.attacked import Attacked

_TAKEN = {
    "plant": PLANT_ACTUATION,
    "sensor": SENSOR_MEASUREMENT,
    "netem": NETEM_PACKET,
    "controller": CONTROLLER_DELIVERY,
}


def ends_well(run: Attacked) -> Iterator[str]:
    """The run reaches its horizon, and every process exits normally."""
    if run.status != 0:
        yield f"exit status {run.status}: {run.stderr.strip()}"
    if run.summary["exit"]["reason"] != "horizon":
        yield f"ended: {run.summary['exit']['reason']}"


def nothing_is_accepted(run: Attacked) -> Iterator[str]:
    """Each process accepted exactly as many datagrams as its peer sent."""
    for role in LOOP_ROLES:
        sent = run.channel(sender_to(role, RECEIVES[role]))["sent"]
        taken = len(run.record[_TAKEN[role]])
        if not sent == run.accepted(role) == taken:
            yield f"{role}: {sent} from its peer, {run.accepted(role)} accepted, {taken} acted on"


def all_are_accounted_for(run: Attacked) -> Iterator[str]:
    """Each hostile datagram was rejected for the expected reason or dropped by the kernel."""
    for role in LOOP_ROLES:
        expected, rejected = run.sent_to(role), dict(run.channel(role)["rejected"])
        shed = rejected.pop(SHED, 0)
        if sum(rejected.values()) + shed != expected.total():
            yield f"{role}: {expected.total()} sent, {rejected} and {shed} shed"
        for reason, n in rejected.items():
            if n > expected[reason]:
                yield f"{role}: {n} rejected for {reason}, {expected[reason]} expected"


def nothing_is_lost(run: Attacked) -> Iterator[str]:
    """All datagrams of the loop arrive, and the record is complete."""
    (loop,) = run.summary["loops"]
    for key in ("unintended_losses", "missing_samples"):
        if loop[key]:
            yield f"{key}: {loop[key]}, {loop['unintended_losses_by_leg']}"
    for role in LOOP_ROLES:
        if run.channel(role)["kernel_drops"] not in (0, None):
            yield f"{role}: {run.channel(role)['kernel_drops']} lost in the kernel"


def the_loop_computes_what_it_should(run: Attacked) -> Iterator[str]:
    """Replay gives the recorded outputs, and (I1) holds to rounding."""
    (loop,) = run.summary["loops"]
    if not (loop["replay"]["bit_exact"] and loop["replay"]["complete"]):
        yield f"replay: {loop['replay']}"
    if not loop["identity_residual_max"] < 1e-11:
        yield f"identity residual {loop['identity_residual_max']}"


def no_claim_is_violated(run: Attacked) -> Iterator[str]:
    """No claim is violated; claims may be void because of deadlines missed on a busy machine."""
    claims = run.summary["loops"][0]["claims"]
    if not any("state" in claim["what"] and claim["certified"] is not None for claim in claims):
        yield "no envelope of the state is claimed"
    yield from (str(claim) for claim in claims if claim["verdict"] == "violated")
    violations = run.summary["loops"][0]["assumption_violations"]
    yield from (str(one) for one in violations if one["cause"] == "dropouts")


CHECKS: Mapping[str, Callable[[Attacked], Iterator[str]]] = {
    check.__name__: check
    for check in (
        ends_well, nothing_is_accepted, all_are_accounted_for, nothing_is_lost,
        the_loop_computes_what_it_should, no_claim_is_violated,
    )
}  # fmt: skip
