"""Loops whose losses are random: probabilities and moments instead of bounds for all patterns.

The paper and the certificates assume at most M − 1 consecutive losses. If nothing enforces this
limit, a run stays within it with some probability (docs/theory.md, "Without a limit on the
losses"). The losses are a Markov chain over the packets
(``noack/impairments/loss_prediction.py``).

1. A certificate for at most m consecutive losses holds for a whole run if no longer burst happens.
   Until then events are at least δ apart, so a run of T seconds has at most ⌊T/δ⌋ + 1 of them; the
   chain gives the probability that this many packets stay within the limit. So the mean of a run's
   largest values is that of the bounds for its longest burst.
2. Moments. Each update is lost with a probability of at most p̄, whatever happened before. In the
   inequalities of a certificate, (I1) then holds for (E‖·‖ʳ)^{1/r} with ρ = p̄^{1/r} in place of
   the number of missing events, or with a law of this number that follows from what has been added
   to e_s. They are linear, or concave, and solved in the same way (``fixed_times.py``). Mean squares
   are bounded once more by a quadratic function of the loop's state, whose mean no event increases
   (``quadratic_moments.py``). A moment that decays as e^{−αt} gives almost sure decay at every
   smaller rate (Borel and Cantelli). ``moments.py`` has the rest of 1 and 2.
3. Time-triggered loops. From one transmission to the next the state becomes M₀z or M₁z. The second
   moments follow a linear map, so its spectral radius decides stability in mean square exactly; its
   bound is proven with all rounding (``mean_square_growth.py``). The same map with weighted outcomes
   bounds the growth almost surely (``random_growth.py``).
4. The same map with disturbances and noise has the stationary moments and the mean cost, with or
   without a limit on the losses (``loop_moments.py``).
"""
