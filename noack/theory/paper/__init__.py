"""The paper's own results: their assumptions, their chain of arguments, their evaluation.

The loop (docs/theory.md, "The loop"). The plant is ẋ = Ax + Bu (eq:plant). Sensor and controller
run the same model ẋ_s = H x_s, ẋ_c = H x_c between updates (eq:ModSensor, eq:ModCont), H = Â + B̂K,
or H = 0 for a hold; u = K x_c. At an event t_k the sensor sends x and sets x_s = x, whether the
update arrives or not. A delivered update sets x_c = x. An event happens when ‖e_s‖ exceeds βe^{−αt}
(eq:thre), e_s = x_s − x and e_c = x_c − x.

(I1) is an identity, because both models have the same matrix and differ by jumps only:

    x_c(t) − x_s(t) = Σ_{k=r+1..q} e^{H(t−t_k)} e_s(t_k⁻)

q is the last event, r the last one whose update the controller has. It holds for every plant,
linear or not, and for every pattern of losses; eq:LossEv2 is the paper's case of it.

(I1) → eq:LossEv3. With the triangle inequality and ‖e_s(t_k⁻)‖ ≤ βe^{−αt_k},

    ‖e_c(t)‖ ≤ βe^{−αt} + Σ_k βe^{−αt_k} ‖e^{H(t−t_k)}‖.

Both sides can be computed along a run. Without the second step, ‖e_c‖ ≤ ‖e_s‖ + Σ ‖e^{H(t−t_k)}
e_s(t_k⁻)‖ holds for every trigger. ``error_bounds.py`` evaluates (I1) and both bounds.

eq:LossEv3 → Theorem 1 (th:ContError). The times t − t_k are bounded by those that e_s needs to
reach the threshold: δ̄_j (eq:deltaa, eq:deltak), from the growth of an unstable A with distinct
eigenvalues (Proposition 1, prop:unstable). With at most M − 1 consecutive losses this gives ‖e_c‖ ≤
Δβe^{−αt}, Δ of eq:Normec. δ̄_j depends on the trajectory and on A, so Δ is known after a run only.
Theorem 3 (th:ContErrorZOH, eq:NormecZOH) is the same for H = 0.

Theorem 1 → Theorem 2 (th:consensus). With ‖e^{(A+BK)t}‖ ≤ c e^{−ᾱt} and 0 < α < ᾱ, the loop driven
by e_c gives the bound of the state, eq:normXt; and ė_s = H e_s − E x − BK e_c (eq:miet_errdyn)
gives the minimum inter-event time, eq:tau with eq:Htil. ``theorems.py`` evaluates Theorems 1 to 3.

What the paper assumes and certificates do not: Proposition 1, whose condition the paper's own
example violates; a continuous trigger; a network and an input without delay. The list, with a
verdict for a scenario, is in ``noack/theory/certificates/assumptions.py``.
"""
