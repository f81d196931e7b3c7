"""A chain or tree of virtual slaves: processing of frames, and timed events."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from rtcp.config.document import read
from rtcp.config.findings import Finding
from rtcp.config.model import ConfigError
from rtcp.config.segment import SegmentConfig, load_segment, place_of
from rtcp.virtual.arm import VirtualArm, make_arm
from rtcp.virtual.described import DescribedDevice
from rtcp.virtual.descriptions import Descriptions
from rtcp.virtual.device import DeviceModel, OptionError
from rtcp.virtual.objects import SdoAbort
from rtcp.virtual.protocol import Register
from rtcp.virtual.slave import Slave, make_slaves
from rtcp.virtual.wire import Miscount, Wire


class Connection(NamedTuple):
    """Connection of a slave: index of the slave before it (None: the master), and that slave's port."""

    parent: int | None
    port: int = 1


def chain(count: int) -> list[Connection]:
    """Return the connections of a chain of slaves."""
    return [Connection(None if place == 0 else place - 1) for place in range(count)]


BRANCHES = (3, 1, 2)
"""Order of the ports that a frame takes after port 0 and processing (ETG.1000.4, 4.3)."""


class Topology:
    """The slaves as a tree, in the order in which frames reach them.

    Cable n leads to the slave at index n, from 0; in a chain it is the cable after slave n, counted from 1. Faults
    count: a cable cut twice must be joined twice.
    """

    def __init__(self, slaves: Sequence[Slave], connections: Sequence[Connection]) -> None:
        """Connect `slaves`; their `delay` is for a frame that passes all of them."""
        self._slaves = tuple(slaves)
        self._parents = [connection.parent for connection in connections]
        self._ports = [connection.port for connection in connections]
        self._children: list[dict[int, int]] = [{} for _ in slaves]
        for place, (parent, port) in enumerate(connections):
            if parent is not None:
                self._children[parent][port] = place
        self._cuts = [0] * len(self._slaves)
        self._outages = [0] * len(self._slaves)
        self._times = [cable.time for cable in lay_cables([slave.delay for slave in slaves], connections)]
        self.reached: tuple[Slave, ...] = ()
        """Slaves reached by a frame, in order."""
        self.returns = True
        """Whether frames return: False if the loop of a port without a link is open."""
        self.update()

    def cable_behind(self, place: int, port: int) -> int | None:
        """Return the cable at a port of a slave, or None."""
        return self._children[place].get(port)

    def path_to(self, cable: int) -> list[tuple[int, int]]:
        """Return index and port of every slave from `cable` to the master."""
        path: list[tuple[int, int]] = []
        place = cable
        while (parent := self._parents[place]) is not None:
            path.append((parent, self._ports[place]))
            place = parent
        return path

    def last_behind(self, cable: int) -> int:
        """Return the index of the last slave that a frame passes before it returns over `cable`."""
        last = cable
        while self._children[last]:
            last = max(self._children[last].values())
        return last

    def cut(self, cable: int) -> None:
        """Break a cable."""
        self._cuts[cable] += 1
        self.update()

    def join(self, cable: int) -> None:
        """Join a cable again."""
        self._cuts[cable] -= 1
        self.update()

    def power_off(self, number: int, t: int) -> None:
        """Switch a slave's supply off."""
        self._outages[number - 1] += 1
        if self._outages[number - 1] == 1:
            self._slaves[number - 1].power_off(t)
        self.update()

    def power_on(self, number: int, t: int) -> None:
        """Switch a slave's supply on again."""
        self._outages[number - 1] -= 1
        if not self._outages[number - 1]:
            self._slaves[number - 1].power_on(t)
        self.update()

    def _linked(self, cable: int | None) -> bool:
        """Whether a cable exists, is whole, and has powered slaves at both ends."""
        if cable is None:
            return False
        if self._cuts[cable] or self._outages[cable]:
            return False
        parent = self._parents[cable]
        return parent is None or not self._outages[parent]

    def update(self) -> None:
        """Update ports and delays after a change of cables or supplies."""
        for place, slave in enumerate(self._slaves):
            if not self._outages[place]:
                children = self._children[place]
                slave.esc.set_links([self._linked(place), *(self._linked(children.get(port)) for port in (1, 2, 3))])
        reached: list[Slave] = []
        self.returns = True
        if self._slaves and self._passes(0):
            self.returns = self._visit(0, self._times[0], reached) is not None
        self.reached = tuple(reached)
        for slave in self._slaves:
            slave.esc.loops_written = False

    def _passes(self, cable: int) -> bool:
        """Whether the slave at the end of `cable` accepts frames from it."""
        return self._linked(cable) and not self._slaves[cable].esc.closed(0, True)

    def _visit(self, place: int, t: int, reached: list[Slave]) -> int | None:
        """Trace a frame that reaches a slave at `t`; return the time at which it leaves port 0, None: it is lost."""
        slave = self._slaves[place]
        slave.delay = arrival = t
        reached.append(slave)
        returns: dict[int, int] = {}
        for port in BRANCHES:
            cable = self._children[place].get(port)
            linked = self._linked(cable)
            if slave.esc.closed(port, linked):
                continue
            if cable is None or not linked:
                return None
            if not self._passes(cable):
                continue
            left_at = self._visit(cable, t + self._times[cable], reached)
            if left_at is None:
                return None
            t = left_at + self._times[cable]
            returns[port] = t - arrival
        if slave.esc.dc is not None:
            slave.esc.dc.returns = returns
        return t

    def restart(self, slave: Slave, t: int) -> None:
        """Reset a slave's controller and device, as by a power cycle."""
        slave.power_off(t)
        slave.power_on(t)
        self.update()


class Cable(NamedTuple):
    """Delay of a cable, ns, and the arrival of a frame at its end."""

    time: int
    arrival: int


def lay_cables(arrivals: Sequence[int | None], connections: Sequence[Connection]) -> list[Cable]:
    """Return the cables for given arrivals of a frame at the slaves, ns from the master.

    Without an arrival (None) the delay is `FURTHER_DELAY`, or 0 for the first cable. A negative delay is invalid: the
    frame would arrive before it left an earlier branch.
    """
    cables: list[Cable] = []
    leaves: list[int] = []
    for place, (parent, _) in enumerate(connections):
        leaves_at = 0 if parent is None else leaves[parent]
        usual = FURTHER_DELAY if place else 0
        arrival = arrivals[place]
        arrival = leaves_at + usual if arrival is None else arrival
        cables.append(Cable(arrival - leaves_at, arrival))
        leaves.append(arrival)
        # The time at which the frame is back at each slave before it, unless another branch follows.
        t, child = arrival, place
        while (above := connections[child].parent) is not None:
            t += cables[child].time
            leaves[above] = t
            child = above
    return cables


DELAYS = (0, 820, 1660, 2500, 3320, 4160, 5020)
"""Propagation delays from the master to the slaves of the robot, ns."""
FURTHER_DELAY = 840
"""Additional delay of every further slave, ns."""
IDLE_TICK: Final = 1_000_000
"""Upper bound on the interval of checks of watchdogs and devices, ns."""
TOGETHER: Final = 2_000
"""SYNC0 pulses within this time are handled together, ns."""
REPLAYED_PULSES: Final = 20
"""Upper bound on SYNC0 pulses replayed after the process was stopped; older ones are skipped."""
BREATH: Final = 50_000
"""Pause of a SYNC0 that is too fast to follow, ns: frames have priority."""


class Damage(NamedTuple):
    """A cable that damages a frame if `strikes` returns True; numbered as in `Topology`."""

    cable: int
    strikes: Callable[[], bool]
    back: bool = False
    """True: frames are damaged on the return path to the master."""


class Segment:
    """The slaves of a segment, driven by three calls.

    `process` answers a frame in place; `settle` executes its effects on the slaves after the answer is sent; `tick`
    handles timed events. `step_one` executes queued steps of the devices, which take long, one at a time, so that
    frames are answered in between. Instants are ns of the host's monotonic clock.
    """

    def __init__(self, slaves: Sequence[Slave], t: int, connections: Sequence[Connection] | None = None) -> None:
        """Connect `slaves`; None: as a chain."""
        self.slaves = tuple(slaves)
        self.topology = Topology(self.slaves, chain(len(self.slaves)) if connections is None else connections)
        self.miscounts: list[Miscount] = []
        self.damages: list[Damage] = []
        self.arm: VirtualArm | None = None
        """The arm moved by the drives; None: each drive has its own load."""
        self._attention: list[Slave] = []
        self._waiting: deque[Slave] = deque()
        self._next_tick = t + IDLE_TICK
        self.next_event = t + IDLE_TICK
        """Instant of the next necessary call of `tick`."""
        self.rewire()

    def rewire(self) -> None:
        """Route frames to the slaves that are reachable now."""
        self._wire = Wire(self.topology.reached, self.miscounts)
        for slave in self.slaves:
            slave.esc.on_attention = self._attention_of(slave)

    def _attention_of(self, slave: Slave) -> Callable[[], None]:
        def call() -> None:
            if slave not in self._attention:
                self._attention.append(slave)

        return call

    def process(self, frame: bytearray, size: int, t: int) -> bool:
        """Answer a frame in place, see `Wire.process`; False: no answer."""
        if self.damages or not self._wire.slaves or not self.topology.returns:
            return self._process_faulty(frame, size, t)
        return self._wire.process(frame, size, t)

    def _process_faulty(self, frame: bytearray, size: int, t: int) -> bool:
        """Answer a frame under faults of cables and slaves."""
        reached, returns = self.topology.reached, self.topology.returns
        damages = [damage for damage in tuple(self.damages) if self.slaves[damage.cable] in reached]
        struck = [damage for damage in damages if damage.strikes()]
        if not struck:
            return bool(reached) and self._wire.process(frame, size, t) and returns
        out = [damage.cable for damage in struck if not damage.back]
        if out:
            far = min(out)
            self._process_until(far, frame, size, t)
            first = self.slaves[far].esc
            first.count(Register.RX_ERRORS)
            first.count(Register.RX_ERRORS + 1)
            self._forward_from(far + 1)
        else:
            # The first one on the frame's return path.
            last, cable = min((self.topology.last_behind(damage.cable), -damage.cable) for damage in struck)
            self._process_until(last + 1, frame, size, t)
            self._count_back(-cable)
            self._forward_from(last + 1)
        return False

    def _process_until(self, far: int, frame: bytearray, size: int, t: int) -> None:
        """Process a frame that is valid only for the slaves before index `far`."""
        sound = [slave for slave in self.topology.reached if slave in self.slaves[:far]]
        whole, self._wire = self._wire, Wire(sound, self.miscounts, passing=True)
        self._wire.process(frame, size, t)
        self.settle(t)
        self._wire = whole

    def _forward_from(self, place: int) -> None:
        """Count a damaged frame at the slaves from index `place`."""
        for slave in self.topology.reached:
            if slave in self.slaves[place:]:
                slave.esc.count(Register.FORWARDED_RX_ERRORS)

    def _count_back(self, cable: int) -> None:
        """Count a frame damaged on its return over `cable` at each slave's receiving port."""
        for n, (place, port) in enumerate(self.topology.path_to(cable)):
            esc = self.slaves[place].esc
            if n:
                esc.count(Register.FORWARDED_RX_ERRORS + port)
            else:
                esc.count(Register.RX_ERRORS + 2 * port)
                esc.count(Register.RX_ERRORS + 2 * port + 1)

    def settle(self, t: int) -> None:
        """Execute the effects of the frames since the last call; the last one arrived at `t`."""
        for followers, reference, at in self._wire.references:
            for slave in followers:
                if slave.clock is not None:
                    slave.clock.follow(at + slave.delay, reference)
        self._wire.references.clear()
        if self._wire.completed:
            # A pending SYNC0 before this frame comes first.
            if self.next_event <= t:
                self.tick(t)
            for plan in self._wire.completed:
                for esc, manager in plan.written:
                    esc.on_outputs(manager, t)
            self._wire.completed.clear()
            for slave in self._wire.slaves:
                if not slave.application.by_sync0:
                    slave.application.latch()
                    self._queue(slave, t)
        if self._attention:
            asking, self._attention = self._attention, []
            for slave in asking:
                try:
                    slave.application.attend(t)
                except Exception as error:
                    slave.device.failed(error)
                if slave.esc.reset_requested:
                    self.topology.restart(slave, t)
                    self.rewire()
                elif slave.esc.loops_written:
                    self.topology.update()
                    self.rewire()
            self.wake_at(t)

    def wake_at(self, t: int) -> None:
        """Request a `tick` at `t`, after a change that it must handle."""
        self._next_tick = min(self._next_tick, t)
        self.next_event = min(self.next_event, self._next_tick)

    def tick(self, now: int) -> None:
        """Handle every SYNC0 up to `now`, and once a millisecond watchdogs and devices without SYNC0."""
        earliest = now + IDLE_TICK
        idle = now >= self._next_tick
        for slave in self.slaves:
            application = slave.application
            dc = slave.esc.dc
            if dc is not None and (due := dc.sync0.due) is not None:
                if due <= now + TOGETHER:
                    due = self._pulse(slave, now)
                if due is not None and due < earliest:
                    earliest = due
            if idle:
                application.watch(now)
                if not application.by_sync0 or not application.sync.running:
                    application.latch()
                    self._queue(slave, now)
        if idle:
            if self.arm is not None:
                self.arm.update(now)
            self._next_tick = now + IDLE_TICK
        self.next_event = min(earliest, self._next_tick)

    def _pulse(self, slave: Slave, now: int) -> int | None:
        """Handle the due SYNC0 pulses of `slave` at `now`; return the instant of its next one."""
        dc = slave.esc.dc
        if dc is None:
            return None
        sync0 = dc.sync0
        cycle = sync0.cycle
        if sync0.due is not None and cycle and now - sync0.due > REPLAYED_PULSES * cycle:
            sync0.skip_to(now - REPLAYED_PULSES * cycle)
        for _ in range(REPLAYED_PULSES + 2):
            due = sync0.due
            if due is None or due > now + TOGETHER:
                return due
            sync0.fire()
            if slave.application.by_sync0:
                slave.application.pulse(now - due < cycle)
                self._queue(slave, due)
        return now + BREATH

    def _queue(self, slave: Slave, t: int) -> None:
        if slave.queued_until is None:
            self._waiting.append(slave)
        slave.queued_until = t

    @property
    def busy(self) -> bool:
        """Whether steps of devices are queued."""
        return bool(self._waiting)

    def step_one(self) -> Slave | None:
        """Step the longest waiting device; return its slave."""
        if not self._waiting:
            return None
        slave = self._waiting.popleft()
        until, slave.queued_until = slave.queued_until, None
        if until is not None:
            try:
                slave.application.advance(until)
            except Exception as error:
                slave.device.failed(error)
        return slave


def default_delays(count: int) -> tuple[int, ...]:
    """Return the propagation delays for a chain of `count` slaves, ns."""
    further = range(max(0, count - len(DELAYS)))
    return (DELAYS + tuple(DELAYS[-1] + FURTHER_DELAY * (n + 1) for n in further))[:count]


def make_segment(config: SegmentConfig, t: int) -> Segment:
    """Build the slaves of `config`; their clocks start at instant `t` (ns, CLOCK_MONOTONIC).

    Raises:
        ConfigError: one sentence for each mistake: unknown model or option, process data too long or with unknown
            objects, delays that decrease along the chain.
    """
    devices: list[DeviceModel] = []
    findings: list[Finding] = []
    descriptions = Descriptions(config.source.parent)
    for i, entry in enumerate(config.slaves):
        key = "esi" if entry.esi is not None else "sii" if entry.sii is not None else "model"
        try:
            device = descriptions.make(entry)
            for index in device.roles.outputs + device.roles.inputs:
                device.lay_out(index)
            devices.append(device)
        except OptionError as error:
            findings += [finding.below("slaves", i) for finding in error.findings]
        except (SdoAbort, ValueError) as error:
            text = f"the process data of {entry.label} cannot be laid out: {error}"
            findings.append(Finding(("slaves", i, key), "process_data", text=text))
    connections, misplaced = _connections(config, devices if len(devices) == len(config.slaves) else None)
    findings += misplaced
    arrivals: list[int | None] = [entry.delay_ns for entry in config.slaves]
    if [connection.parent for connection in connections] == [None, *range(len(arrivals) - 1)]:
        usual = default_delays(len(arrivals))
        arrivals = [own if arrival is None else arrival for arrival, own in zip(arrivals, usual, strict=True)]
    cables = [] if misplaced else lay_cables(arrivals, connections)
    for i, cable in enumerate(cables):
        if cable.time < 0:
            before = cable.arrival - cable.time
            text = f"found {cable.arrival} ns, allowed is at least the {before} ns of the slave before it"
            findings.append(Finding(("slaves", i, "delay_ns"), "delay_falls", text=text))
    if findings:
        raise ConfigError(read(config.source).placed(findings))
    drifts = [entry.drift_ppm for entry in config.slaves]
    aliases = [entry.alias for entry in config.slaves]
    bits = [entry.clock_bits for entry in config.slaves]
    slaves = make_slaves(devices, drifts, [cable.arrival for cable in cables], aliases, t, bits)
    segment = Segment(slaves, t, connections)
    segment.arm = make_arm(config, devices)
    document = read(config.source) if any(isinstance(device, DescribedDevice) for device in devices) else None
    for i, device in enumerate(devices):
        if isinstance(device, DescribedDevice) and document is not None:
            device.runner.place = f"{config.source}:{document.line(('slaves', i))}: slave {i + 1}"
    return segment


def _connections(
    config: SegmentConfig, devices: Sequence[DeviceModel] | None
) -> tuple[list[Connection], list[Finding]]:
    """Return the connection of each slave, and the mistakes; without `devices` ports are not checked."""
    connections: list[Connection] = []
    findings: list[Finding] = []
    places: dict[Connection, int] = {}
    for i, entry in enumerate(config.slaves):
        parent = i - 1 if entry.after is None else place_of(entry.after, config.slaves[:i])
        if parent is None or i == 0:
            connections.append(Connection(None))
            continue
        label = f"slave {parent + 1} ({config.slaves[parent].label})"
        physics = "" if devices is None else devices[parent].physics[:4]
        ports = [port for port, kind in enumerate(physics) if port and kind != " "]
        connection = Connection(parent, entry.port or (1 if 1 in ports or not ports else ports[0]))
        connections.append(connection)
        if devices is not None and connection.port not in ports:
            text = f"found {connection.port}, but {label} has {_listed(ports)} to hang something at"
            findings.append(Finding(("slaves", i, "port"), "no_port", text=text))
        elif places.setdefault(connection, i) != i:
            text = f"found {connection.port} of {label}, where slave {places[connection] + 1} hangs already"
            findings.append(Finding(("slaves", i, "port"), "port_taken", text=text))
    if not findings:
        for expected, place in enumerate(_wire_order(connections)):
            if place != expected:
                text = f"frames come to this slave before slave {expected + 1} ({config.slaves[expected].label})"
                text = f"{text}: list it before that one"
                return connections, [Finding(("slaves", place, "after"), "order", text=text)]
    return connections, findings


def _listed(ports: Sequence[int]) -> str:
    return f"port{'s' if len(ports) > 1 else ''} {' and '.join(map(str, ports))}" if ports else "no port"


def _wire_order(connections: Sequence[Connection]) -> list[int]:
    """Return the indices of the slaves in the order of a frame's path."""
    order: list[int] = []
    waiting = [0]
    while waiting:
        place = waiting.pop()
        order.append(place)
        children = [child for child, connection in enumerate(connections) if connection.parent == place]
        waiting += sorted(children, key=lambda child: BRANCHES.index(connections[child].port), reverse=True)
    return order


def check_segment(path: Path) -> None:
    """Check that a segment can be built from the file.

    Raises:
        ConfigError: one sentence for each mistake: file, line, key, value, allowed values.
    """
    make_segment(load_segment(path), 0)
