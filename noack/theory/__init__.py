"""What is certified of a loop, and why, in five parts, to be read in this order.

1. ``paper.py``: the identity (I1), the bounds of ‖e_c‖ that follow from it along a run, and the
   paper's theorems as printed.
2. ``bounds``: the numbers on which certificates rest. Suprema and integrals of responses, enclosed
   between samples; the gains of a loop; what a trigger and the disturbances contribute.
3. ``certificates``: the inequalities between all signals of a loop, their solution, and what it
   guarantees of a scenario, with its assumptions.
4. ``witnesses``: the search for what noack-check proves: bounds, regions, and the growth of a loop
   whose sensor is time-triggered, or has a longest time between events. ``time_triggered`` has the
   maps of such loops.
5. ``random_losses``: what holds if nothing limits the number of consecutive losses.

``coverage.py`` and ``keys.toml`` say which settings of a scenario all this covers.

The docstring of each part has its chain of arguments. Labels such as eq:LossEv3 are those of the
paper's source. docs/theory.md states the results, docs/derivations.md has the proofs and a table of
the files. Modules are imported in the order bounds, paper, certificates and
time_triggered, random_losses and witnesses: the paper's formulas need enclosed suprema, too.

Modules of scipy are imported in the functions that use them: their import takes longer than that of
everything else here, and most certificates do not need them.
"""
