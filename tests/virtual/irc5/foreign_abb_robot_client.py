"""abb-robot-client as the PC: `python foreign_abb_robot_client.py PORT TARGET` leads joint 1 to TARGET degrees.

It sends positions alone: the arm follows by the controller's own law. Prints the last joint 1 as JSON.
"""

from __future__ import annotations

import json
import sys
import time

import numpy as np
from abb_robot_client.egm import EGM


def main() -> None:
    port, target = int(sys.argv[1]), float(sys.argv[2])
    egm = EGM(port)
    print("ready", flush=True)
    end, answered, state = time.monotonic() + 20.0, 0, None
    while time.monotonic() < end:
        received, latest = egm.receive_from_robot(timeout=1.0)
        if not received:
            continue
        state = latest
        reference = np.array(state.joint_angles)
        reference[0] = target
        answered += egm.send_to_robot(reference)
        if abs(state.joint_angles[0] - target) < 0.1:
            break
    print(json.dumps({
        "joint": state.joint_angles[0], "answered": answered, "motors_on": state.motors_on,
        "rapid_running": state.rapid_running, "pose": [float(value) for value in state.cartesian[0]],
    }))  # fmt: skip


main()
