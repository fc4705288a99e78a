"""Certificates: the bounds that hold for a loop before it runs, their conditions and assumptions.

``noack certify lane_following`` prints those of the paper's example.

1. ``conditions.py`` derives from a scenario what a certificate assumes: the number of consecutive losses, the
   times h between tests, d until an update acts, σ, the age of inputs, and that of the first input. It says
   how likely a run keeps a guarantee on the losses that nothing enforces.
2. ``assumptions.py`` lists every assumption of the paper and of the certificate about a scenario, with a
   verdict.
3. ``plant_equations.py`` has the equations of a plant that is not linear, for the checker to enclose.
4. ``proven_bounds.py`` has what the checker has proven, as numbers: each bound is D₁e^{−rt} + D₂.
5. ``certified_bounds.py``: a certificate, which is what was proven, or the reason why nothing was, with the
   conditions and assumptions. ``output_bounds.py``: what it says about each output, in its own unit.

The search for what can be proven is in :mod:`noack.theory.witnesses`, the proof in :mod:`noack.proof`.
"""
