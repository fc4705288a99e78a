"""Random networks: every loss model, impairment, discipline and constraint, with small numbers."""

from tests.fuzz.scenarios.chances import Chances, Table


def network(of: Chances, loops: int, horizon_s: float, *, acknowledged: bool) -> Table:
    """Return a network for some loops."""
    table = direction(of, loops, horizon_s, forward=True)
    table["mansd"] = of.integer(0, 2 if of.gentle else 5)
    table.setdefault("loss", {"model": "lossless"})
    of.put(table, 0.07, "enforce_mansd", of.flag)
    of.put(table, 0.3, "initial_sync", lambda: of.one_of("first_packet", "known_state"))
    of.put(table, 0.1, "encrypted", of.flag)
    if acknowledged:
        table["protocol"] = "ack"
        back = direction(of, loops, horizon_s, forward=False)
        of.put(back, 0.4, "timeout_s", lambda: of.size(0.02, 0.3))
        of.put(table, 0.6, "acknowledgements", lambda: back)
    else:
        of.put(table, 0.1, "protocol", lambda: "none")
        often = 0.1 if of.gentle else 0.2
        of.put(table, often, "actuation", lambda: direction(of, loops, horizon_s, forward=False))
    return table


def direction(of: Chances, loops: int, horizon_s: float, *, forward: bool) -> Table:
    """Return what happens to the packets of a direction; with a bound of the losses if they may be many."""
    table: Table = {}
    of.put(table, 0.85, "loss", lambda: loss(of, horizon_s))
    of.put(table, 0.85, "mansd", lambda: of.integer(0, 4))
    if "mansd" in table or forward:
        of.put(table, 0.25, "constraints", lambda: constraints(of))
    often = 0.15 if of.gentle else 0.4
    of.put(table, often, "impairments", lambda: impairments(of, loops, horizon_s, forward=forward))
    of.put(table, 0.15, "limit", lambda: of.one_of(1, 2, 3, 8, 100))
    return table


def constraints(of: Chances) -> list[Table]:
    """Return one or two constraints of different kinds."""
    losses = of.integer(1, 3)
    at_most: Table = {"losses": losses, "window": losses + of.integer(1, 6)}
    of.put(at_most, 0.7, "kind", lambda: "at_most")
    recovery: Table = {"kind": "recovery", "deliveries": of.integer(1, 3)}
    return of.one_of([at_most | {"kind": "at_most"}], [recovery], [at_most | {"kind": "at_most"}, recovery])


def loss(of: Chances, horizon_s: float, *, changed: bool = False) -> Table:
    """Return a loss model; one that a change sets is no trace."""
    kinds = [_bernoulli, _four_state, _gilbert_elliott, _lossless, _periodic, _scripted, _worst_case]
    if not changed:
        kinds.append(_trace)
    return of.one_of(*kinds)(of, horizon_s)


def _bernoulli(of: Chances, horizon_s: float) -> Table:
    table: Table = {"model": "bernoulli", "probability": of.share()}
    of.put(table, 0.3, "correlation", lambda: of.share(0.9))
    of.put(table, 0.15, "keep", lambda: True)
    if table.get("keep"):
        table["probability"] = of.share(0.25)  # the guarantee must leave as much
    return table


def _four_state(of: Chances, horizon_s: float) -> Table:
    table: Table = {"model": "four_state", "p13": of.share(0.5), "p31": of.share(0.5)}
    of.put(table, 0.5, "p32", lambda: of.share(0.4))
    of.put(table, 0.5, "p23", of.share)
    of.put(table, 0.5, "p14", lambda: of.share(0.4))
    return table


def _gilbert_elliott(of: Chances, horizon_s: float) -> Table:
    table: Table = {"model": "gilbert_elliott"}
    if of.chance(0.4):
        return table | {"mean_loss": of.share(0.4), "mean_burst": of.size(1.5, 6.0)}
    table |= {"good_to_bad": of.share(0.5), "bad_to_good": of.between(0.1, 1.0)}
    of.put(table, 0.3, "loss_in_good", lambda: of.share(0.2))
    of.put(table, 0.3, "loss_in_bad", lambda: of.between(0.5, 1.0))
    if of.chance(0.3):
        table |= {"state": "link", "step_s": of.size(0.005, 0.5)}
    return table


def _lossless(of: Chances, horizon_s: float) -> Table:
    return {"model": "lossless"}


def _periodic(of: Chances, horizon_s: float) -> Table:
    table: Table = {"model": "periodic", "period": of.integer(1, 8)}
    of.put(table, 0.6, "burst", lambda: of.integer(0, table["period"]))
    of.put(table, 0.5, "first", lambda: of.integer(0, table["period"] - 1))
    return table


def _scripted(of: Chances, horizon_s: float) -> Table:
    lost = sorted({of.integer(0, 30) for _ in range(of.integer(0, 15))})
    table: Table = {"model": "scripted", "lost": lost}
    of.put(table, 0.5, "repeat_every", lambda: of.integer(31, 40))
    return table


def _trace(of: Chances, horizon_s: float) -> Table:
    digits = "".join(of.one_of("0", "1") for _ in range(of.integer(5, 40)))
    table: Table = {"model": "trace", "file": of.file("losses", ".txt", "\n".join(digits) + "\n")}
    of.put(table, 0.4, "repeat", of.flag)
    return table


def _worst_case(of: Chances, horizon_s: float) -> Table:
    return {"model": "worst_case"}


def impairments(of: Chances, loops: int, horizon_s: float, *, forward: bool) -> list[Table]:
    """Return one or two impairments that may stand together."""
    kinds = [_blackout, _corrupt, _delay, _duplicate, _loss_of, _opportunities, _rate, _reorder, _replay]
    first = of.one_of(*kinds, _schedule, _rate)(of, loops, horizon_s)
    scheduled = first.get("discipline", {}).get("kind") in ("earliest_deadline", "priority", "maximum_error")
    if scheduled and first["discipline"]["kind"] == "maximum_error" and not forward:
        first["discipline"] = {"kind": "tail_drop"}
    if scheduled:
        return of.one_of(
            [first], [_corrupt(of, loops, horizon_s), first], [{"kind": "delay", "delay_s": 0.01}, first]
        )
    if of.chance(0.6):
        return [first]
    return [first, of.one_of(_corrupt, _delay, _duplicate, _loss_of, _reorder)(of, loops, horizon_s)]


def _blackout(of: Chances, loops: int, horizon_s: float) -> Table:
    begin = of.between(0.1, 0.5) * horizon_s
    end = begin + of.between(0.02, 0.3)
    table: Table = {"kind": "blackout"}
    if of.chance(0.3):
        table["file"] = of.file("outages", ".txt", f"{begin:.6f}s {end:.6f}s\n")
    else:
        table["intervals_s"] = [[begin, end]]
    of.put(table, 0.4, "every_s", lambda: end + of.between(0.05, 0.5))
    return table


def _chance_of(kind: str, of: Chances) -> Table:
    table: Table = {"kind": kind, "probability": of.share(0.4)}
    of.put(table, 0.3, "correlation", lambda: of.share(0.9))
    return table


def _corrupt(of: Chances, loops: int, horizon_s: float) -> Table:
    return _chance_of("corrupt", of)


def _duplicate(of: Chances, loops: int, horizon_s: float) -> Table:
    return _chance_of("duplicate", of)


def _delay(of: Chances, loops: int, horizon_s: float) -> Table:
    table: Table = {"kind": "delay"}
    of.put(table, 0.8, "delay_s", lambda: of.size(0.001, 0.08))
    if of.chance(0.2):
        table["distribution"] = "empirical"
        samples = sorted(of.size(0.001, 0.06) for _ in range(of.integer(2, 8)))
        if of.chance(0.5):
            table["samples_s"] = samples
        else:
            table["file"] = of.file("delays", ".txt", "".join(f"{sample:.9f}\n" for sample in samples))
    elif of.chance(0.6):
        table["jitter_s"] = of.size(0.0005, 0.03)
        kinds = ("uniform", "normal", "pareto", "paretonormal")
        of.put(table, 0.5, "distribution", lambda: of.one_of(*kinds))
        of.put(table, 0.3, "correlation", lambda: of.share(0.9))
    of.put(table, 0.2, "ordered", lambda: True)
    of.put(table, 0.1, "loss_correlation", lambda: of.between(-1.0, 1.0))
    return table


def _loss_of(of: Chances, loops: int, horizon_s: float) -> Table:
    return {"kind": "loss", "loss": loss(of, horizon_s)}


def _opportunities(of: Chances, loops: int, horizon_s: float) -> Table:
    times_ms = sorted({of.integer(0, 400) for _ in range(80)})
    table: Table = {"kind": "opportunities"}
    if of.chance(0.4):
        table["file"] = of.file("opportunities", ".txt", "".join(f"{time}\n" for time in times_ms))
    else:
        table["times_ms"] = times_ms
    of.put(table, 0.3, "queue", lambda: of.integer(2, 50))
    of.put(table, 0.3, "queue_bytes", lambda: of.integer(300, 20_000))
    of.put(table, 0.3, "overhead_bytes", lambda: of.integer(-20, 60))
    of.put(table, 0.3, "offset_s", lambda: of.one_of("random", of.between(0.0, 0.3)))
    return table


def _rate(of: Chances, loops: int, horizon_s: float) -> Table:
    table: Table = {"kind": "rate", "rate_bps": int(of.size(2e5, 1e7))}
    limit = of.one_of("queue", "queue_bytes", "queue_s")
    sizes = {
        "queue": of.integer(2, 30),
        "queue_bytes": of.integer(300, 20_000),
        "queue_s": of.size(0.01, 0.2),
    }
    of.put(table, 0.5, limit, lambda: sizes[limit])
    of.put(table, 0.3, "burst_bytes", lambda: of.integer(300, 20_000))
    of.put(table, 0.3, "overhead_bytes", lambda: of.integer(-20, 60))
    if of.chance(0.2):
        table |= {"cell_bytes": of.integer(20, 60), "cell_overhead_bytes": of.integer(0, 10)}
    of.put(table, 0.6, "discipline", lambda: _discipline(of, loops))
    if table.get("discipline", {}).get("kind") in ("earliest_deadline", "maximum_error", "priority"):
        table.pop("burst_bytes", None)
    return table


def _discipline(of: Chances, loops: int) -> Table:
    codel: Table = {"kind": "codel"}
    of.put(codel, 0.5, "target_s", lambda: of.size(0.001, 0.02))
    of.put(codel, 0.5, "interval_s", lambda: of.size(0.02, 0.2))
    of.put(codel, 0.5, "mtu_bytes", lambda: of.integer(0, 1500))
    numbers = range(of.integer(1, loops + 1))
    return of.one_of(
        codel,
        {"kind": "earliest_deadline", "deadlines_s": [of.size(0.005, 0.1) for _ in numbers]},
        {"kind": "maximum_error"},
        {"kind": "priority", "levels": [of.integer(0, 3) for _ in numbers]},
        {"kind": "tail_drop"},
    )


def _reorder(of: Chances, loops: int, horizon_s: float) -> Table:
    table: Table = {"kind": "reorder"}
    of.put(table, 0.8, "probability", lambda: of.share(0.6))
    of.put(table, 0.3, "correlation", lambda: of.share(0.9))
    of.put(table, 0.4, "gap", lambda: of.integer(1, 4))
    return table


def _replay(of: Chances, loops: int, horizon_s: float) -> Table:
    count = of.integer(3, 20)
    sent_ns = [20_000_000 * record for record in range(count)]
    delays_ns = [-1 if of.chance(0.3) else int(of.size(1e5, 5e7)) for _ in range(count)]
    table: Table = {"kind": "replay"}
    if of.chance(0.4):
        rows = [f"{sent / 1e9:.9f},{'' if delay < 0 else f'{(sent + delay) / 1e9:.9f}'}\n"
                for sent, delay in zip(sent_ns, delays_ns, strict=True)]  # fmt: skip
        table["file"] = of.file("trace", ".csv", "sent_s,received_s\n" + "".join(rows))
        of.put(table, 0.3, "clocks_differ", of.flag)
    else:
        table |= {"sent_ns": sent_ns, "delays_ns": delays_ns}
    of.put(table, 0.4, "by", lambda: of.one_of("packet", "time"))
    of.put(table, 0.3, "repeat", of.flag)
    of.put(table, 0.3, "offset_s", lambda: of.one_of("random", of.between(0.0, 0.04)))
    of.put(table, 0.3, "delay_share", of.share)
    return table


def _schedule(of: Chances, loops: int, horizon_s: float) -> Table:
    order = [*range(loops), *([-1] if of.chance(0.3) else [])]
    table: Table = {"kind": "schedule", "order": order, "slot_s": of.size(0.001, 0.02)}
    of.put(table, 0.4, "queue", lambda: of.integer(2, 30))
    return table
