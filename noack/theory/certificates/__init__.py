"""Certificates: the bounds that hold for a loop before it runs, their conditions and proof.

``noack certify lane_following`` prints those of the paper's example.

From (I1) to a certificate (docs/theory.md, "Certificates"; docs/derivations.md, "Closing the
loop"):

1. ``inequalities.py``. (I1) bounds ‖C e_c‖ by D_C β̃ (``error_rows.py``): the present e_s, plus at
   most N missing events, each propagated by e^{(H+αI)τ}. N is the longest loss burst plus ⌈d/δ⌉
   updates in flight.
   The plant bounds ‖C x‖ by free + gain · sup‖p‖; between two tests β̃ grows from β; a held
   input is of age ≤ σ. All these inequalities are linear in non-negative numbers. If the loop gain
   is below 1, their solution bounds the run at all times, by induction over time: Δ (of the size of
   eq:Normec, but without Proposition 1), X (eq:normXt) and β̃.
2. ``solution.py``. The minimum inter-event time δ is the time that e_s needs from 0 to the
   threshold under these bounds (eq:miet_errdyn; the paper's is eq:tau). N and D_C depend on δ, so
   the largest consistent δ is used.
3. ``persistent_bounds.py``. With persistent disturbances, noise, an observer or a constant threshold, each
   bound has a decaying part and a persistent part. All inequalities are linear in functions of
   time, so the bounds of the two parts are added.
4. ``scenario_certificates.py``. Which of these a scenario gets, for its own plant and for the box;
   ``constants_search.py``: at which rate of decay.
   ``network_limits.py``: the largest sampling period, delay and age of inputs that are certified.
5. ``region.py``. A nonlinear plant is one of the plants of a box, as long as x and u stay in the
   region over which its equations are enclosed; they do if the box's bounds are inside it.
6. ``certified_bounds.py``. The guarantee as bounds over time; and sharper ones from the newest
   event on, at which the sensor knows x (docs/theory.md, "From the newest event").

What a certificate assumes: ``conditions.py`` derives h, d, σ and the losses from a scenario, and
moves a set-point to 0; ``refusals.py`` says for which settings and times together there is none;
``assumptions.py`` lists every assumption of the paper and of the
certificate, with a verdict. A run that violates a condition voids the claims from that time on.

``trigger_weight.py`` chooses W of the trigger's norm such that a certificate is tight.
"""
