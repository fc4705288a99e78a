"""The colours of the viewer, the reports and the library's figures. One concept, one colour.

Every colour has a contrast of at least 3 to 1 with a light and with a dark background. Colours in
one panel can be distinguished by colour-blind people as well. Lines and marks also differ in width,
dash or marker.
"""

Colour = tuple[int, int, int]

PLANT: Colour = (155, 142, 159)
"""The plant and its state x."""
SENSOR: Colour = (51, 93, 213)
"""The sensor: x_s, e_s, transmissions."""
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
"""Bounds from the paper's formulas."""
LOST: Colour = (120, 90, 150)
"""Lost packets."""
FORCED: Colour = (0, 150, 255)
"""Deliveries forced by the guarantee."""
SERIES: tuple[Colour, ...] = (SENSOR, CONTROLLER, FORCED, PRINTED, THRESHOLD, PLANT)
"""Colours for series without their own colour."""
PROCESSES: dict[str, Colour] = {
    "plant": PLANT,
    "sensor": SENSOR,
    "netem": NETWORK,
    "controller": CONTROLLER,
}
