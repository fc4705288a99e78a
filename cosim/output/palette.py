"""The colours of every picture: the viewer's, the reports', the library's. One concept, one colour.

Every colour stands out from a light and from a dark background, 3 to 1. Colours that appear in one
panel can be told apart by colour-blind people as well; a test computes both. What they colour also
differs in width, dash or marker.
"""

Colour = tuple[int, int, int]

PLANT: Colour = (155, 142, 159)
"""The plant and its state x."""
SENSOR: Colour = (51, 93, 213)
"""The sensor: x_s, e_s, broadcasts."""
CONTROLLER: Colour = (255, 86, 10)
"""The controller: x_c, e_c, deliveries."""
NETWORK: Colour = (165, 75, 75)
THRESHOLD: Colour = (150, 90, 120)
"""The trigger's threshold."""
CERTIFIED: Colour = (51, 162, 78)
"""Bounds that a certificate guarantees."""
IDENTITY: Colour = (200, 115, 215)
"""The bound from identity (I1)."""
PRINTED: Colour = (180, 60, 0)
"""Bounds by the paper's printed formulas."""
LOST: Colour = (120, 90, 150)
"""Lost packets."""
FORCED: Colour = (0, 150, 255)
"""Deliveries forced by the guarantee."""
SERIES: tuple[Colour, ...] = (SENSOR, CONTROLLER, FORCED, PRINTED, THRESHOLD, PLANT)
"""For what has no colour of its own."""
PROCESSES: dict[str, Colour] = {
    "plant": PLANT,
    "sensor": SENSOR,
    "netem": NETWORK,
    "controller": CONTROLLER,
}
