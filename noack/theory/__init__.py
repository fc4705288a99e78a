"""What is guaranteed of a loop, and why, in five parts, to be read in this order.

1. ``paper.py``: the identity (I1), the bounds of ‖e_c‖ that follow from it along a run, and the
   paper's theorems as printed.
2. ``witnesses``: the search for what noack-check proves: bounds, regions, and the growth of a loop
   whose sensor is time-triggered, or has a longest time between events.
3. ``certificates``: what was proven of a scenario, as bounds over time, with its conditions and assumptions.
4. ``time_triggered``: the maps of loops whose sensor transmits at times that do not depend on measurements.
5. ``random_losses``: what holds if nothing limits the number of consecutive losses.

``coverage.py`` says which loops the paper's identities, exact simulation and mean costs cover; what proofs
cover is in ``noack/proof/elaborate/keys.toml``. ``response_bounds.py`` encloses responses of linear systems.

Each bound of a certificate was verified by a program of ``checker/``, which has the rules. Labels such as
eq:LossEv3 are those of the paper's source. docs/theory.md states the results, docs/derivations.md has the
proofs and a table of the files.
"""
