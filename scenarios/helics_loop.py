"""A loop over HELICS: plant and controller of `double_integrator`, which do not know noack.

The plant has its sensor, which sends the state when the controller's model of it is wrong. Its
updates go to `noack/controller/update`; that destination is all that the network needs.
docs/howto.md has the commands, and tests compare the states with those of `noack simulate`.
"""

import math
import sys
from struct import pack, unpack

import helics
import numpy as np
from scipy.linalg import expm

STEP_S, STEPS = 0.002, 1000
A, B = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
TRUE_B = 1.2 * B  # of the plant, unknown to sensor and controller
K = np.array([[-1.0, -math.sqrt(2.0)]])
BETA, ALPHA_PER_S, FLOOR = 0.05, 0.3, 0.001
MODEL_STEP = expm(STEP_S * (A + B @ K))
PLANT_STEP = expm(STEP_S * np.block([[A, TRUE_B], [np.zeros((1, 3))]]))  # of [x, u]


def federate(name, endpoint, broker):
    """Return a federate that messages do not wake, and its endpoint."""
    info = helics.helicsCreateFederateInfo()
    helics.helicsFederateInfoSetCoreTypeFromString(info, "zmq")
    helics.helicsFederateInfoSetCoreInitString(info, "--loglevel=error")
    if broker:
        helics.helicsFederateInfoSetBroker(info, broker)
    helics.helicsFederateInfoSetFlagOption(info, helics.HELICS_FLAG_UNINTERRUPTIBLE, True)
    found = helics.helicsCreateMessageFederate(name, info)
    own = helics.helicsFederateRegisterGlobalEndpoint(found, endpoint, "")
    helics.helicsFederateEnterExecutingMode(found)
    return found, own


def newest(endpoint):
    """Return the numbers in the last message that has come, or None."""
    found = None
    while helics.helicsEndpointHasMessage(endpoint):
        data = helics.helicsMessageGetBytes(helics.helicsEndpointGetMessage(endpoint))
        found = unpack(f"{len(data) // 8}d", data)
    return found


def plant(broker):
    """Integrate x, test the trigger, send updates; print t, x and whether there was an event."""
    own, endpoint = federate("plant", "plant/input", broker)
    x, x_s, u = np.array([1.0, 0.0]), None, 0.0
    for k in range(STEPS + 1):
        t = k * STEP_S
        if k:
            helics.helicsFederateRequestTime(own, t)
            x, x_s = (PLANT_STEP @ [*x, u])[:2], MODEL_STEP @ x_s
            (u,) = newest(endpoint) or (u,)
        threshold = max(BETA * math.exp(-ALPHA_PER_S * t), FLOOR)
        is_event = x_s is None or np.linalg.norm(x - x_s) > threshold
        if is_event:
            x_s = x
            helics.helicsEndpointSendBytesTo(endpoint, pack("3d", t, *x), "noack/controller/update")
        print(t, *x, int(is_event), sep=",")
    helics.helicsFederateDisconnect(own)


def controller(broker):
    """Advance the model from the newest update, and send u = K x_c to the plant."""
    own, endpoint = federate("controller", "controller/update", broker)
    x_c = None
    for k in range(STEPS):
        t = (k + 0.5) * STEP_S  # between two steps of the plant
        helics.helicsFederateRequestTime(own, t)
        x_c = x_c if x_c is None else MODEL_STEP @ x_c
        if update := newest(endpoint):
            sent, *x = update
            x_c = expm((t - sent) * (A + B @ K)) @ x
        if x_c is not None:
            helics.helicsEndpointSendBytesTo(endpoint, pack("d", *(K @ x_c)), "plant/input")
    helics.helicsFederateDisconnect(own)


if __name__ == "__main__":
    role, *address = sys.argv[1:]
    {"plant": plant, "controller": controller}[role]("".join(address))
    helics.helicsCloseLibrary()
