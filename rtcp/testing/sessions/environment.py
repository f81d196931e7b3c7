"""What happens around a simulated arm: hands, loads, false or late measurements, bursts of lost frames.

Everything begins at once or some cycles later, lasts for a while beside the commands, and follows from random numbers.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from math import pi
from random import Random

from rtcp.config.model import ArmConfig, Joint
from rtcp.fieldbus.pdo import Channel, layout
from rtcp.testing.inputs import Inputs
from rtcp.testing.simulation import Simulation
from rtcp.virtual.models.mechanics import GRAVITY
from rtcp.virtual.models.servo import ServoAxis

HAND_FRACTION = 0.6
"""Largest torque of a hand at a joint, as a fraction of the joint's torque limit."""
HEAVIEST_KG = 1.5
"""Heaviest load that the arm's model does not know, kg."""
MEASURED = ("statusword", "position", "velocity", "torque", "modes_of_operation_display")
"""Channels that can be false."""
FALSE_CYCLES = (1, 1, 2, 4, 4, 8)
"""Cycles of a false sample: the loop bridges up to 4 of them, and calls more a fault."""
LATE_CYCLES = (1, 2, 4, 8)
"""Cycles by which a drive's answer is late."""
STUCK_NS = 200_000_000
"""Time for which a value that was stuck has consequences: what it let the joints do has to come to rest."""
BURSTS = ((39, 39), (1, 1), (1, 3), (10, 10), (3, 30))
"""Lost and good frames of a burst that repeats."""
LASTING_FAULTS = (0x3210, 0x3220, 0x4310)
"""Error codes whose cause can last: the supply voltage, and heat."""

Transform = Callable[[bytes], bytes]
"""Inputs of a slave -> those that the loop gets."""


class Environment:
    """The surroundings of one arm. `step` runs once a cycle; every other method begins something.

    Args:
        random: source of randomness.
        simulation: the arm.
        servos: the drives of its joints.
        inputs: contacts of its IO box.
        note: called with the name and the details of what begins.

    Attributes:
        pushed: torque of a hand at each pushed joint, Nm, by the joint's number from 0.
        payload_kg: mass at the tool that the arm's model does not know, kg.
        false_until_ns: simulated time until which the loop gets false or late inputs.
        stuck_until_ns: simulated time until which a value of each drive is stuck, or its consequences last.
        last_disturbed_ns: simulated time of the last cycle in which anything of the above acted, or a change of it.
        permitted: whether the enabling switch is pressed.
    """

    def __init__(
        self,
        random: Random,
        simulation: Simulation,
        servos: Sequence[ServoAxis],
        inputs: Inputs,
        note: Callable[[str, str], None],
    ) -> None:
        self.pushed: dict[int, float] = {}
        self.payload_kg = 0.0
        self.false_until_ns = 0
        self.stuck_until_ns = [0] * len(servos)
        self.last_disturbed_ns = 0
        self.permitted = True
        self._random, self._simulation, self._inputs, self._note = random, simulation, inputs, note
        self._config: ArmConfig = simulation.config
        self._servos = servos
        self._mechanics = [servo.mechanics for servo in servos]
        slots = {slave.name: slot for slot, slave in enumerate(self._config.slaves)}
        self._slots = [slots[joint.slave] for joint in self._config.joints]
        self._due: list[tuple[int, int, Callable[[], object]]] = []
        """Instant, number and action of what is still to come; the earliest is the last."""
        self._count = 0
        self._lies: dict[int, Transform] = {}
        """What the loop gets from a slave, by the slave's index."""
        self._true = simulation.data.input
        self._drop_load: Callable[[int], None] | None = None

    @property
    def idle(self) -> bool:
        """Whether nothing acts and nothing is to come."""
        return not (self._due or self.pushed or self.payload_kg or self._lies)

    def step(self, now_ns: int) -> None:
        """Let what is due happen."""
        due = self._due
        while due and due[-1][0] <= now_ns:
            due.pop()[2]()
        if self.pushed or self._lies:
            self.last_disturbed_ns = now_ns

    def _after(self, cycles: int, action: Callable[[], object]) -> None:
        at_ns = self._simulation.now_ns + cycles * self._simulation.period_ns
        self._count += 1
        self._due.append((at_ns, self._count, action))
        self._due.sort(key=lambda entry: (-entry[0], -entry[1]))

    def _cycles(self, least_s: float, most_s: float) -> int:
        return max(1, int(self._random.uniform(least_s, most_s) * 1e9 / self._simulation.period_ns))

    def later(self, action: Callable[[], object], seconds: float) -> None:
        """Begin something within this time, s."""
        self._after(self._cycles(0.0, seconds), action)

    # -- hands ------------------------------------------------------------------------------------------------------

    def push(self, axis: int, torque: float) -> None:
        """Push a joint from now on, Nm; 0 ends it."""
        # Beside the weight of the arm, which the segment puts there.
        self._mechanics[axis].external_torque += torque - self.pushed.pop(axis, 0.0)
        if torque:
            self.pushed[axis] = torque
        self.last_disturbed_ns = self._simulation.now_ns

    def hand(self) -> None:
        """Let a hand push a joint for a while: anywhere, or against its motion."""
        random = self._random
        axis = random.randrange(len(self._mechanics))
        size = random.uniform(0.1, 1.0) * HAND_FRACTION * self._config.joints[axis].torque
        against, sign = random.random() < 0.5, random.choice((-1.0, 1.0))
        duration = self._cycles(0.02, 0.6)

        def begin() -> None:
            velocity = self._mechanics[axis].velocity
            torque = -size if against and velocity > 0.0 else size if against and velocity < 0.0 else sign * size
            self._note("hand", f"{axis} {torque:.1f}")
            self.push(axis, torque)
            self._after(duration, lambda: self.push(axis, 0.0))

        self._after(self._cycles(0.0, 0.3), begin)

    def carry(self, mass: float) -> None:
        """Put a load on the tool that the arm's model does not know, kg; 0 takes it off."""
        arm = self._simulation.bus.segment.arm
        if arm is None:
            return
        now_ns = self._simulation.now_ns
        if self._drop_load is not None:
            self._drop_load(now_ns)
        self._drop_load = arm.push((0.0, 0.0, -mass * GRAVITY, 0.0, 0.0, 0.0)) if mass else None
        self.payload_kg, self.last_disturbed_ns = mass, now_ns
        self._note("load", f"{mass:.2f} kg")

    def load(self) -> None:
        """Put a load on the tool for a while."""
        self.carry(self._random.uniform(0.1, HEAVIEST_KG))
        self._after(self._cycles(0.1, 1.0), lambda: self.carry(0.0))

    # -- measurements -----------------------------------------------------------------------------------------------

    def falsify(self) -> None:
        """Give the loop one false sample of a drive for some cycles."""
        random = self._random
        axis, name, cycles = self._axis(), random.choice(MEASURED), random.choice(FALSE_CYCLES)
        joint = self._config.joints[axis]
        channel = self._channel(axis, name)
        if channel is None:
            return
        kind = random.choice(("turn", "wrap", "zero", "random", "negated"))
        drawn, first, last = (
            random.getrandbits(channel.bits),
            channel.bit_offset // 8,
            channel.bit_offset // 8 + channel.bits // 8,
        )
        turn = round(2.0 * pi / abs(channel.factor)) if channel.factor else 1

        def change(inputs: bytes) -> bytes:
            true = int.from_bytes(inputs[first:last], "little")
            false = {
                "turn": true + turn, "wrap": true ^ 1 << channel.bits - 1, "zero": 0, "random": drawn, "negated": -true
            }[kind]  # fmt: skip
            return inputs[:first] + (false % (1 << channel.bits)).to_bytes(last - first, "little") + inputs[last:]

        self._lie_later(axis, cycles, change, f"{joint.name} {name} {kind} {cycles} cycles")

    def freeze(self) -> None:
        """Let a drive show one of its values unchanged for a while: a stuck position, a mode display that is late."""
        random = self._random
        axis = self._axis()
        name = random.choice(("position", "velocity", "modes_of_operation_display"))
        channel = self._channel(axis, name)
        if channel is None:
            return
        first, last = channel.bit_offset // 8, channel.bit_offset // 8 + channel.bits // 8
        shown: list[bytes] = []

        def change(inputs: bytes) -> bytes:
            if not shown:
                shown.append(inputs[first:last])
            return inputs[:first] + shown[0] + inputs[last:]

        self._lie_later(
            axis, self._cycles(0.002, 0.2), change, f"{self._config.joints[axis].name} {name} stuck", STUCK_NS
        )

    def delay(self) -> None:
        """Let all answers of a drive be late for a while."""
        axis, late = self._axis(), self._random.choice(LATE_CYCLES)
        simulation = self._simulation
        kept: deque[tuple[int, bytes]] = deque(maxlen=late + 1)
        """The last inputs and their instants."""

        def change(inputs: bytes) -> bytes:
            if not kept or kept[-1][0] != simulation.now_ns:
                kept.append((simulation.now_ns, inputs))
            return kept[0][1]

        self._lie_later(axis, self._cycles(0.02, 0.5), change, f"{self._config.joints[axis].name} {late} cycles late")

    def _axis(self) -> int:
        return self._random.randrange(len(self._slots))

    def _channel(self, axis: int, name: str) -> Channel | None:
        joint: Joint = self._config.joints[axis]
        return layout(self._config.slaves[self._slots[axis]].device.of_axis(joint.axis).tpdo).find(name)

    def _lie_later(self, axis: int, cycles: int, change: Transform, what: str, lasts_ns: int = 0) -> None:
        """Change the inputs of a joint's slave for some cycles, from some later cycle on; one change at a time.

        A value that is stuck has consequences for `lasts_ns` after the last of these cycles.
        """
        slot, simulation = self._slots[axis], self._simulation

        def begin() -> None:
            if slot in self._lies:
                return
            self._note("false measurement", what)
            self._lies[slot] = change
            simulation.data.input = self._input  # type: ignore[method-assign]
            # The loop gets the first of them in the next cycle.
            until_ns = simulation.now_ns + cycles * simulation.period_ns
            self.false_until_ns = max(self.false_until_ns, until_ns)
            if lasts_ns:
                self.stuck_until_ns[axis] = until_ns + lasts_ns
            self._after(cycles, end)

        def end() -> None:
            del self._lies[slot]
            if not self._lies:
                simulation.data.input = self._true  # type: ignore[method-assign]

        self._after(self._cycles(0.0, 0.3), begin)

    def _input(self, index: int) -> bytes:
        change, inputs = self._lies.get(index), self._true(index)
        return inputs if change is None else change(inputs)

    # -- drives, bus and operator -----------------------------------------------------------------------------------

    def lasting_fault(self) -> None:
        """Let a drive fail for a cause that lasts for a while, so that a reset fails until then."""
        servo, code = self._random.choice(self._servos), self._random.choice(LASTING_FAULTS)
        self._note("lasting fault", f"0x{code:04X}")
        servo.begin_fault(code)
        self._after(self._cycles(0.1, 1.5), lambda: servo.end_fault(code))

    def burst(self) -> None:
        """Lose frames again and again, with good ones in between."""
        random = self._random
        lost, good = random.choice(BURSTS)
        out = random.random() < 0.5
        self._note("burst", f"{lost} lost {'out' if out else 'back'}, {good} good")
        self._lose_again(lost, good, out, max(2, self._cycles(0.05, 0.5) // (lost + good)))

    def _lose_again(self, lost: int, good: int, out: bool, times: int) -> None:
        self._simulation.data.lose(lost, not out)
        self.last_disturbed_ns = self._simulation.now_ns + lost * self._simulation.period_ns
        if times > 1:
            self._after(lost + good, lambda: self._lose_again(lost, good, out, times - 1))

    def switch(self, pressed: bool) -> bool:
        """Press or release the enabling switch; return whether there is one."""
        contact = self._config.inputs.enabling_switch
        if contact is None or not self._inputs.present:
            return False
        self._note("enabling switch", "pressed" if pressed else "released")
        self._inputs.set(contact, pressed)
        self.permitted = pressed
        return True
