"""Random scenarios of one loop with a linear plant: every policy and feature, in many combinations.

Some times are drawn on the loop's grids, so that much happens at the same time; numbers that are
compared with each other are drawn from intervals, so that they are hardly ever equal.
"""

from typing import Any

import numpy as np
from scipy.linalg import solve_continuous_are

Content = dict[str, Any]
POLICIES = (
    "decaying", "absolute", "relative", "mixed", "quadratic", "lyapunov", "dynamic", "send_on_area",
    "periodic", "self_triggered", "deadline", "dwell",
)  # fmt: skip
RATES_HZ = (50.0, 100.0, 125.0, 200.0)
HORIZON_S = 2.0
_CHANGEABLE = {
    "decaying": "beta", "absolute": "delta", "relative": "sigma", "mixed": "epsilon",
    "quadratic": "epsilon", "lyapunov": "rate_per_s", "dynamic": "sigma", "send_on_area": "delta_s",
    "periodic": "period_s", "self_triggered": "beta", "deadline": "interval_s",
    "dwell": "interval_s",
}  # fmt: skip


def random_scenario(number: int) -> Content:
    """Return the content of a scenario; its policy is ``POLICIES[number % 12]``."""
    return _Draw(np.random.default_rng(number)).scenario(POLICIES[number % len(POLICIES)])


class _Draw:
    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.n, self.m = int(rng.integers(1, 4)), int(rng.integers(1, 3))
        self.rate_hz = self.one_of(*RATES_HZ)
        self.every = self.one_of(1, 1, 2, 3)

    def chance(self, probability: float) -> bool:
        return bool(self.rng.random() < probability)

    def one_of(self, *choices: Any) -> Any:
        return choices[self.rng.integers(len(choices))]

    def seed(self) -> int:
        return int(self.rng.integers(1000))

    def between(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def entries(self, low: float, high: float, *shape: int) -> Any:
        return self.rng.uniform(low, high, shape).tolist()

    def scenario(self, policy: str) -> Content:
        acknowledged = self.chance(0.15)
        A, B, K = self.model()
        self.rest = -np.linalg.solve(A, B)  # x = rest @ u is an equilibrium
        x_r = None if acknowledged or self.chance(0.5) else self.equilibrium()
        content: Content = {
            "name": "random",
            "mode": self.one_of("model", "model", "zoh"),
            "horizon_s": HORIZON_S,
            "seeds": {"plant": self.seed(), "loss": self.seed(), "noise": self.seed()},
            "model": {"A": A.tolist(), "B": B.tolist(), "gain": K.tolist()},
            "plant": self.plant(),
            "trigger": self.trigger(policy),
            "network": self.network(acknowledged=acknowledged),
            "controller": self.controller(x_r),
        }  # fmt: skip
        self.observe(content)
        self.watch(content, model=x_r is None)
        if not acknowledged and self.chance(0.35):
            content["changes"] = self.changes(content, x_r)
        if self.chance(0.25):
            controller = content["controller"]
            controller["update_timeout_s"] = self.one_of(0.06, self.between(0.005, 0.3))
            controller["timeout_input"] = self.one_of("safe", "hold")
        can_follow = x_r is None and not acknowledged and content["plant"]["watchdog"]["policy"] != "model"
        if can_follow and self.chance(0.5):
            content["controller"]["reference"] = self.reference()
        return content

    def reference(self) -> list[Content]:
        """Return pieces for one output, or for two if there are as many inputs."""
        outputs = self.rng.permutation(self.n)[: int(self.rng.integers(1, min(self.n, self.m) + 1))]
        return [piece for output in outputs for piece in self.pieces(f"x_{output + 1}")]

    def pieces(self, output: str) -> list[Content]:
        """Return pieces of an output; times are on the plant's grid or between."""
        first, second = (
            self.one_of(0.0, 0.4, self.between(0.0, 0.4)),
            self.one_of(0.9, self.between(0.7, 0.9)),
        )
        kinds: list[Content] = [
            {"kind": "step", "value": self.between(-0.5, 0.5)},
            {"kind": "ramp", "rate_per_s": self.between(-0.5, 0.5)},
            {"kind": "sine", "amplitude": self.between(0.1, 0.5), "hz": self.between(0.2, 2.0)},
        ]
        pieces = [self.one_of(*kinds) | {"output": output, "from_s": from_s} for from_s in (first, second)]
        pieces[1]["join_s"] = self.one_of(0.0, 0.3)
        if self.chance(0.5):
            pieces[1]["until_s"] = 1.5
        return pieces

    def model(self) -> tuple[Any, Any, Any]:
        """Return Â, B̂ and the regulator's gain; without modes that hardly react to the input."""
        while True:
            A = self.rng.uniform(-1.5, 1.5, (self.n, self.n))
            B = self.rng.uniform(-2, 2, (self.n, self.m))
            K = -B.T @ solve_continuous_are(A, B, np.eye(self.n), np.eye(self.m))
            if np.abs(K).max() < 10 and np.linalg.cond(A) < 100:
                return A, B, K

    def equilibrium(self) -> Any:
        x_r = self.rest @ self.rng.uniform(-1, 1, self.m)
        return (0.5 * x_r / np.linalg.norm(x_r)).tolist()

    def plant(self) -> Content:
        n, m, rng = self.n, self.m, self.rng
        plant: Content = {
            "draw": "uniform",
            "uncertainty_A": self.entries(0.0, 0.3, n, n),
            "uncertainty_B": self.entries(0.0, 0.2, n, m),
            "initial_state": (rng.choice([-1, 1], n) * rng.uniform(0.3, 1.0, n)).tolist(),
            "rate_hz": self.rate_hz,
            "measure_every": self.every,
        }
        disturbances = [
            {"kind": "gaussian", "std": self.entries(0.1, 0.4, m)},
            {"kind": "uniform", "at": "state", "bound": self.entries(0.1, 0.4, n)},
            {"kind": "sine", "amplitude": self.entries(0.1, 0.4, m), "hz": 1.7, "phase_rad": 0.3},
            {"kind": "step", "at": "state", "amplitude": self.entries(0.1, 0.9, n), "from_s": 0.5},
        ]
        if self.chance(0.4):
            plant["disturbances"] = [disturbance for disturbance in disturbances if self.chance(0.5)]
        return plant

    def trigger(self, policy: str, *, inner: bool = False) -> Content:
        between, n = self.between, self.n
        measured_s = self.every / self.rate_hz
        size = between(0.02, 0.1)
        tables: dict[str, Content] = {
            "decaying": {"beta": between(0.1, 0.3), "alpha_per_s": between(0.5, 2.0),
                         "floor": self.one_of(0.0, size)},
            "absolute": {"delta": size},
            "relative": {"sigma": between(0.1, 0.4)},
            "mixed": {"sigma": between(0.05, 0.2), "epsilon": size},
            "quadratic": {"Q": self.form(), "epsilon": size**2,
                          "period_s": self.one_of(1, 2, 3) * measured_s,
                          "heartbeat": self.one_of(0, 7)},
            "lyapunov": {"rate_per_s": between(0.1, 0.8)},
            "dynamic": {"sigma": between(0.05, 0.4), "theta_s": self.one_of(0.003, 0.1, 1.0),
                        "decay_per_s": self.one_of(0.0, between(0.2, 2.0)),
                        "eta_0": self.one_of(0.0, 0.1)},
            "send_on_area": {"delta_s": size / 10},
            "periodic": {"period_s": self.one_of(0.06, between(0.03, 0.2))},
            "self_triggered": {"beta": between(0.1, 0.5), "alpha_per_s": between(0.2, 1.0),
                               "floor": size, "growth_per_s": self.one_of(0.0, 1.3),
                               "mismatch_per_s": between(0.3, 1.0),
                               "disturbance_per_s": between(0.0, 0.2), "shortest_s": 0.03,
                               "longest_s": 0.4},
        }  # fmt: skip
        if policy in ("deadline", "dwell"):
            kinds = [policy for policy in POLICIES if not inner or policy in tables]
            rule = self.trigger(self.one_of(*kinds), inner=True)
            return {"policy": policy, "rule": rule, "interval_s": between(0.05, 0.3)}
        table = {"policy": policy} | tables[policy]
        if self.chance(0.3):
            table["weight"] = (np.diag(self.rng.uniform(0.5, 2, n)) + 0.1).tolist()
        if policy in ("lyapunov", "dynamic") and self.chance(0.5):
            table["Q"] = np.diag(self.rng.uniform(0.5, 2, n)).tolist()
        return table

    def form(self) -> Any:
        """Return zᵀQz = ‖e_s‖² − σ²‖x‖² and some products of both."""
        n = self.n
        Q = np.diag([-self.between(0.01, 0.1)] * n + [1.0] * n)
        Q[:n, n:] = self.rng.uniform(-0.1, 0.1, (n, n))
        return ((Q + Q.T) / 2).tolist()

    def direction(self) -> Content:
        """Return losses and impairments; a packet is not both corrupted and copied."""
        losses = [
            {"model": "bernoulli", "probability": self.between(0.1, 0.8)},
            {"model": "gilbert_elliott", "mean_loss": 0.4, "mean_burst": 3},
            {"model": "worst_case"},
            {"model": "lossless"},
        ]
        grid_s = 1 / self.rate_hz
        impairments = [
            [],
            [{"kind": "delay", "delay_s": self.one_of(1, 2, 5) * grid_s}],
            [{"kind": "delay", "delay_s": 0.03, "jitter_s": 0.029},
             {"kind": "duplicate", "probability": 0.3}],
            [{"kind": "delay", "delay_s": 0.05}, {"kind": "reorder", "probability": 0.3}],
            [{"kind": "corrupt", "probability": 0.3}],
            [{"kind": "rate", "rate_bps": 20_000, "queue": 4}],
        ]  # fmt: skip
        return {"loss": self.one_of(*losses), "impairments": self.one_of(*impairments),
                "mansd": int(self.rng.integers(0, 6))}  # fmt: skip

    def network(self, *, acknowledged: bool) -> Content:
        network = self.direction()
        network["initial_sync"] = self.one_of("first_packet", "known_state")
        if acknowledged:
            network |= {"protocol": "ack", "acknowledgements": self.direction()}
            if self.chance(0.5):
                network["acknowledgements"]["timeout_s"] = self.between(0.03, 0.2)
        elif self.chance(0.5):
            network["actuation"] = self.direction()
        return network

    def controller(self, x_r: Any) -> Content:
        controller: Content = {
            "rate_hz": self.one_of(*RATES_HZ),
            "phase": self.one_of(0.0, 0.5, self.between(0.0, 0.99)),
            "predictions": self.one_of(1, 1, 2, 4),
        }
        if self.chance(0.3):
            controller["safe_input"] = self.entries(-0.5, 0.5, self.m)
        if x_r is not None:
            controller["setpoint"] = x_r
        return controller

    def observe(self, content: Content) -> None:
        """Add an observer, or noise without one."""
        n, plant = self.n, content["plant"]
        if not self.chance(0.4):
            if self.chance(0.2):
                plant["measurement"] = {"noise_std": self.entries(0.001, 0.01, n)}
            return
        p = int(self.rng.integers(1, n + 1))
        plant["measurement"] = {
            "C": self.rng.uniform(-1, 1, (p, n)).tolist(), "noise_std": self.entries(0.01, 0.03, p),
            "noise_bound": self.entries(0.0, 0.02, p),
        }  # fmt: skip
        observer: Content = {"kind": "kalman", "initial_std": [0.5] * n}
        observer |= self.one_of(
            {"process_std": [0.3] * n}, {"process_std": [0.2] * n, "input_std": [0.4] * self.m},
            {"Q": (0.001 * np.eye(n)).tolist(), "R": (0.01 * np.eye(p)).tolist()},
        )  # fmt: skip
        if self.chance(0.4):
            observer = {"kind": "luenberger", "poles_per_s": [-4.0 - i for i in range(n)]}
        if self.chance(0.3):
            observer["initial_estimate"] = self.entries(-0.5, 0.5, n)
        content["observer"] = observer

    def watch(self, content: Content, *, model: bool) -> None:
        """Add a watchdog; some act often, since the timeout is short where actuations are lost."""
        kinds = ("hold", "zero", "model") if model else ("hold", "zero")
        content["plant"]["watchdog"] = {"policy": self.one_of(*kinds)}
        if self.chance(0.6):
            controller = content["controller"]
            ticks = controller["predictions"] + self.one_of(0, 0, 1)
            content["plant"]["watchdog"]["timeout_s"] = ticks / controller["rate_hz"]

    def changes(self, content: Content, x_r: Any) -> list[Content]:
        """Return changes of trigger, network and set point, some on the plant's grid."""
        trigger, changes = content["trigger"], []
        for begin_s in (0.0, 0.7, 1.3)[self.one_of(0, 1) :]:
            key = _CHANGEABLE[trigger["policy"]]
            new = {f"trigger.{key}": trigger[key] * self.one_of(0.5, 1.5)}
            if "alpha_per_s" in trigger:
                new["trigger.alpha_per_s"] = trigger["alpha_per_s"] * {0.0: 3.0, 0.7: 0.5, 1.3: 8.0}[begin_s]
            if self.chance(0.4):
                new["network.mansd"] = int(self.rng.integers(0, 4))
            if x_r is not None and self.chance(0.6):
                new["controller.setpoint"] = self.equilibrium()
            at_s = begin_s + self.one_of(0.0, 0.2, self.between(0.0, 0.5))
            changes.append({"at_s": at_s, "set": new})
        return changes
