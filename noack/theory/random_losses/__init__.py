"""Loops whose losses are random: probabilities and moments instead of bounds for all patterns.

The paper and the certificates assume at most M − 1 consecutive losses. If nothing enforces this
limit, a run stays within it with some probability (docs/theory.md, "Without a limit on the
losses"). The losses are a Markov chain over the packets
(``noack/impairments/loss_prediction.py``).

1. ``unlimited_losses.py``. What is certified of a scenario. A certificate for at most m consecutive
   losses holds for a whole run if no longer burst happens. Until then events are at least δ apart,
   so a run of T seconds has at most ⌊T/δ⌋ + 1 of them; the chain gives the probability that this
   many packets stay within the limit. So the mean of a run's largest values is that of the bounds
   for its longest burst. The other bounds are moments, and follow from 2 and 3.
2. ``mean_square_bounds.py``. Each update is lost with a probability of at most p̄, whatever happened
   before. In the inequalities of a certificate, (I1) then holds for (E‖·‖ʳ)^{1/r} with ρ = p̄^{1/r}
   in place of the number of missing events, or with a law of this number that follows from what has
   been added to e_s. They are linear, or concave, and solved in the same way. A moment that decays
   as e^{−αt} gives almost sure decay at every smaller rate (Borel and Cantelli).
3. ``stochastic_lyapunov.py`` makes these bounds smaller: a quadratic function of the loop's state,
   whose mean no event increases. ``matrix_inequalities.py`` looks for the function.

Time-triggered loops have exact answers:

4. ``mean_square_growth.py``. From one transmission to the next the state becomes M₀z or M₁z. The
   second moments follow a linear map, so its spectral radius decides stability in mean square; its
   bound is proven with all rounding.
5. ``almost_sure_growth.py``. The same map with weighted outcomes bounds the growth of almost all
   runs.
6. ``exact_moments.py``. The same map with disturbances and noise has the stationary moments and the
   mean cost, with or without a limit on the losses.
"""
