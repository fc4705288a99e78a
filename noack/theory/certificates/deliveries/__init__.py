"""From delivery to delivery: bounds that use that all follows from x at the last delivery.

``inequalities.py`` adds the errors of missing events as if each had a direction of its own. But
from one delivery to the next, x and e_c follow a linear system from one state: x at the delivery.
Two lines of argument use this. Both are for one known plant without disturbances.

An ellipsoid that x never leaves sharpens the constants of the inequalities:

1. ``delivery_flow.py``. The system, e^{Fτ} at the nodes of a grid, and what delayed and held inputs
   change of it.
2. ``delivery_reach.py``. Bounds of x and e_c for all states of an ellipsoid at the delivery. If
   they lead back into the ellipsoid until the next one, x never leaves it. Where several conditions
   are used together, ``ellipsoid_intersections.py`` has the bounds.
3. ``invariant_ellipsoids.py``. The search for such an ellipsoid that is small.
4. ``lost_events.py``. Bounds of e_c after 0, 1, … lost events, and the time until the next event.
5. ``inserted_bounds.py``. The inequalities, into which any bound that holds is inserted.
6. ``sharpened_constants.py``. All of these in turns, until the bounds have settled. Tests may be
   sampled, updates delayed, and inputs held.

If events are due at finitely many times, x is followed from one delivery to the next by balls:

7. ``delivery_gaps.py``. The gains of one gap between two deliveries.
8. ``delivery_balls.py``. The balls of all times, and a return of their centres.
9. ``due_deliveries.py``. The balls from x(0) on, until all later bounds are smaller.

Words of names and fields, and their symbols in the docstrings:

* ``flow``: z = (x, e_c) from one delivery to the next, scaled by e^{αt}, in coordinates in which
  ‖·‖_W is ‖·‖. ``states`` is e^{Fτ} (I, 0) at the nodes, ``edges_s``, of a grid; between two nodes
  is a ``cell``.
* ``ellipsoid``, ``scaling``: ‖Λξ‖ ≤ 1, and Λ. A ``reach`` is what z can be if ‖Λξ‖ ≤ c at the delivery
  (``scale`` is c) and ‖e_c‖_W ≤ D since then (``error_bound`` is D).
* ``effects``: what delay and hold change of the flow. ``age_input`` bounds ‖q‖, the part of the
  input that its age adds; ``first_error`` bounds ‖e_c‖_W when an update acts.
* ``bend`` and ``sag``: as in ``noack/theory/bounds``. ``forms``: matrices Q with zᵀQz ≤ 1. ``level``:
  the least ‖e_s‖_W at an event.
* ``KnownBounds``: the bounds that hold already. ``after_losses`` has one for each number of events
  that have been lost since a delivery.
* ``gap``: the time g between two delivered events. ``late_effect``: J, by how much the error that an
  update removes changes the input while the update is in flight; ``late_effects``: S, the sum of
  these of all updates in flight. ``gains``: the table of ``GapGains``.
* A ball: ‖ξ − ``centre``‖ ≤ ``radius`` ρ in coordinates Λξ. ``weighted_sum``: ρ + θS. ``extent``: ρ,
  S, and this sum. A ``return``: ξ(t) = κ c(t − m) + r.
"""
