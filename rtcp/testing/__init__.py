"""An arm in one process, in simulated time: for tests of plug-ins, for experiments and for training.

    with Simulation(load(default_config())) as arm:
        arm.hold()
        arm.do(MoveJoints((0.2, 0.0, 0.0, 0.0, 0.0, 0.0), 0.5, True))
        arm.bring_to(State.HOLDING)

The loop, the guards and the device models are those of the platform; `rtcp.testing.bus` lists the omissions.
"""

from rtcp.testing.bus import InProcessBus
from rtcp.testing.cell import CellSimulation
from rtcp.testing.simulation import NAME, Frame, InlineService, Simulation

__all__ = ["NAME", "CellSimulation", "Frame", "InProcessBus", "InlineService", "Simulation"]
