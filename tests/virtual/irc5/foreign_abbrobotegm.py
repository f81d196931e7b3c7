"""ABBRobotEGM as the PC: `python foreign_abbrobotegm.py PORT TARGET` leads joint 1 to TARGET degrees.

It sends positions with speed references along a ramp. Prints the last joint 1 as JSON.
"""

from __future__ import annotations

import json
import sys
import time

import numpy as np
from ABBRobotEGM import EGM

SPEED = 20.0
"""Speed of the ramp, degrees/s."""


def main() -> None:
    port, target = int(sys.argv[1]), float(sys.argv[2])
    with EGM(port) as egm:
        print("ready", flush=True)
        end, answered, start = time.monotonic() + 20.0, 0, None
        while time.monotonic() < end:
            received, state, _ = egm.receive_latest(timeout=1.0)
            if not received:
                continue
            start = start or (time.monotonic(), state.joint_angles[0])
            reference, speed = np.array(state.joint_angles), np.zeros(6)
            reference[0] = min(target, start[1] + SPEED * (time.monotonic() - start[0]))
            speed[0] = SPEED if reference[0] < target else 0.0
            answered += egm.send_to_robot(reference, speed_ref=speed)
            if abs(state.joint_angles[0] - target) < 0.1 and not speed[0]:
                break
        print(json.dumps({
            "joint": state.joint_angles[0], "answered": answered, "motors_on": state.motors_on,
            "rapid_running": state.rapid_running, "pose": [state.cartesian.pos.x, state.cartesian.pos.y,
                                                           state.cartesian.pos.z],
        }))  # fmt: skip


main()
