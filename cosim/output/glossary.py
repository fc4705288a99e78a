"""The project's words: what each means, for the report, the lab page and ``docs/glossary.md``."""

TERMS: tuple[tuple[str, str], ...] = (
    ("event", "The trigger's condition is met: the sensor transmits."),
    ("update", "The datagram that the sensor transmits at an event. It carries the plant's state, "
     "or the sensor's estimate of it, and resets the controller's model when it is delivered."),
    ("x, x_s, x_c", "The state of the plant, of the sensor's model and of the controller's model. "
     "The errors are e_s = x_s − x, which the trigger tests, and e_c = x_c − x, which no process "
     "of the loop can measure."),
    ("MANSD, M − 1, M", "The paper's maximum allowable number of successive dropouts (MANSD) is "
     "M − 1: the network loses at most M − 1 consecutive updates. network.mansd = 4 in a scenario "
     "means M − 1 = 4."),
    ("forced", "Delivered because the guarantee requires it: M − 1 consecutive updates were lost "
     "before it, or a further constraint on losses was reached."),
    ("in flight", "Inside the network: sent, and neither delivered nor lost yet."),
    ("missing", "A missing update was sent but is not delivered: it is lost or in flight. A "
     "missing sample was written by a process but is not in the record."),
    ("ideal loop", "The paper's loop, with the plant and the losses of the run: the trigger is "
     "tested at all times, and an update acts without delay."),
    ("claim", "A statement about the loop that each run is checked against, with its conditions: "
     "a bound of a certificate, of identity (I1), or of the paper."),
    ("held, violated", "Held: the observed values stayed within the claim's bound. Violated: they "
     "exceeded it although the claim's conditions were met."),
    ("void", "A condition of the claim was violated, or data are missing. The claim was checked "
     "until then, and says nothing about the time after."),
)  # fmt: skip
"""Terms and their meanings, in an order in which each uses earlier ones only."""


def as_markdown() -> str:
    """Return the terms as the table of ``docs/glossary.md``."""
    rows = [f"| **{term}** | {meaning} |" for term, meaning in TERMS]
    return "\n".join(["| term | meaning |", "|---|---|", *rows])
