"""The numbers on which certificates rest: rigorous upper bounds of a loop's responses.

All signals are scaled by e^{αt}, so that a decaying bound becomes a constant one. A certificate
then needs numbers of three kinds only: sup_τ ‖C e^{Gτ} D‖, ∫ ‖C e^{Gτ} D‖ dτ, and their parts over
an interval, for G = H + αI (the models) and G = A + BK + αI (the plant's loop). Read in this order:

1. ``contraction.py``: coordinates L in which G contracts, ‖L e^{Gs} Y‖ ≤ ‖L Y‖ e^{−νs}. L comes
   from a Lyapunov equation or from eigenvectors; ν is computed from the final L, so nothing depends
   on how L was found. ``stacked_norms.py`` has products and norms of many matrices at once.
2. ``enclosure.py``: the suprema and integrals. Between two nodes the distance of a response from
   its chord (``sag`` in names) is bounded by its second derivative (``bend``); beyond the last node
   ν bounds the response. Why samples are not sufficient: docs/theory.md, "Why the suprema are
   enclosed, not sampled".
3. ``gains.py``: the names of these numbers. With K = U R the input error p = u − Kx acts through B
   U (docs/theory.md, "The loop", eq:miet_errdyn in the form of the three equations there):

       x' = (A + BK) x + B p,   e_s' = H e_s − E x − B p,   E = A + BK − H

   ``ErrorGains`` depends on the models alone; D_C, the gain from ‖e_s‖ to ‖C e_c‖ with N missing
   events, follows from (I1). ``PlantGains`` has sup‖C x‖ ≤ free + gain · sup‖p‖, with x(0) and the
   disturbances in ``free``.
4. ``box.py``: the same gains for every plant of an uncertainty box; the model error is one more
   input, bounded by a small-gain argument over its entries.
5. ``certificate_terms.py``: the data of a certificate: its assumptions on the network, the bound of
   ‖e_s‖ that a trigger guarantees, and the certified bounds.
6. ``trigger_bounds.py``: the bound of ‖e_s‖ after each test, for every trigger rule.
7. ``error_growth.py``: the growth of e_s from this bound until the next test, or from 0 after an
   event until the rule can transmit again (Volterra's inequality, iterated).
8. ``disturbances.py``: bounded and normal disturbances and noise, and the error of an observer, as
   sums over their sources (docs/derivations.md, "Disturbances and noise", "The observer's error").

``noack/theory/certificates`` combines these bounds.
"""
