"""An experiment: starts a platform, records, draws pictures, and compares its figures with the thesis.

Its folder holds `recording*.mcap`, each picture as PNG and SVG, and `result.json`, the input of a report.
"""

from __future__ import annotations

import json
import os
import platform
import shutil
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from functools import cached_property
from math import isfinite, nan
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import psutil
from ruamel.yaml import YAML

from rtcp.api import Robot, RtcpError
from rtcp.config.find import find_config
from rtcp.config.loader import load
from rtcp.config.model import VIRTUAL, ArmConfig
from rtcp.ipc.observer import BlackboardError
from rtcp.ipc.recording import RecordingError, versions
from rtcp.ipc.session import SessionError
from rtcp.launch.launcher import StartOptions
from rtcp.virtual.request_socket import RequestRefused, ServerAway

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RESULT = "result.json"
SPEED_RAD_S = 0.2
"""Speed of the moves before and after a measurement, rad/s."""
LOCK_TIMEOUT_S = 10.0
Source = float | str | None


_FAILURES = (
    RecordingError, ServerAway, RequestRefused, SessionError, BlackboardError, psutil.Error, RuntimeError,
)  # fmt: skip
"""Exceptions when the platform ends during an experiment, or a fit has no solution."""


class ExperimentFailed(Exception):
    """An experiment cannot be carried out or evaluated; the message says why."""


@dataclass(frozen=True)
class Row:
    """A figure: the thesis' value (`source`), the value measured here, and the bounds of the aim."""

    figure: str
    unit: str
    here: float
    source: Source = None
    least: float | None = None
    most: float | None = None

    @property
    def met(self) -> bool | None:
        """Whether it lies between its bounds; None: it has none. NaN misses them."""
        if self.least is None and self.most is None:
            return None
        return bool((self.least is None or self.here >= self.least) and (self.most is None or self.here <= self.most))

    @property
    def verdict(self) -> str:
        """`met` in a word."""
        return {None: "", True: "met", False: "missed"}[self.met]

    @property
    def aim(self) -> str:
        """Its bounds in words."""
        if self.least is None:
            return "" if self.most is None else f"at most {self.most:g}"
        return f"at least {self.least:g}" if self.most is None else f"{self.least:g} to {self.most:g}"


def shown(value: Source) -> str:
    """Return a figure as text: four digits, and 0 for round-off."""
    if value is None or isinstance(value, str):
        return value or ""
    return "not measured" if not isfinite(value) else "0" if abs(value) < 1e-9 else f"{value:.4g}"


@dataclass(frozen=True)
class Result:
    """Result of an experiment."""

    name: str
    title: str
    command: str
    """Command that repeats it."""
    began: str
    """Time of its begin, ISO 8601, local time."""
    seconds: float
    host: Mapping[str, str]
    rows: tuple[Row, ...]
    pictures: tuple[str, ...] = ()
    """Names of the picture files, without their endings."""
    notes: tuple[str, ...] = ()

    @property
    def met(self) -> bool:
        """Whether no row misses its bounds."""
        return not any(row.met is False for row in self.rows)

    def write(self, folder: Path) -> None:
        """Write `result.json`; raises OSError."""
        rows = [
            {**asdict(row), "here": float(row.here) if isfinite(row.here) else None, "met": row.met}
            for row in self.rows
        ]
        (folder / RESULT).write_text(json.dumps({**asdict(self), "rows": rows}, indent=1) + "\n")


def read_result(folder: Path) -> Result:
    """Return the result in a folder.

    Raises:
        ExperimentFailed: there is none, or it is of another version.
    """
    path = folder / RESULT
    try:
        values = json.loads(path.read_bytes())
        rows = tuple(map(_row, values["rows"]))
        texts = {name: tuple(map(str, values[name])) for name in ("pictures", "notes")}
        typed = {"seconds": float(values["seconds"]), "host": dict(values["host"])}
        return Result(**{**values, **texts, **typed, "rows": rows})
    except OSError as error:
        raise ExperimentFailed(f"{path}: it cannot be read: {error.strerror}") from error
    except (ValueError, TypeError, LookupError, AttributeError) as error:
        raise ExperimentFailed(f"{path}: it is no result of an experiment: {error}") from error


def _row(values: Mapping[str, Any]) -> Row:
    others = {name: value for name, value in values.items() if name != "met"}
    return Row(**{**others, "here": nan if values["here"] is None else float(values["here"])})


@dataclass
class Setup:
    """Environment of an experiment: platform, folder and notes.

    Args:
        folder: folder of the experiment; it exists.
        start: context in which a platform runs; it leaves nothing running.
        report: receives each step in a sentence.
        config: file of the arm; None: the one of `rtcp start`.
        bus: name of the bus; None: the configured one.
    """

    folder: Path
    start: Callable[[StartOptions], AbstractContextManager[object]]
    report: Callable[[str], None]
    config: Path | None = None
    bus: str | None = None
    pictures: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @cached_property
    def arm(self) -> ArmConfig:
        """The configuration of the arm; raises ConfigError."""
        return load(find_config(self.config))

    @property
    def is_virtual(self) -> bool:
        """Whether the arm is on the virtual segment."""
        return (self.bus or self.arm.bus.interface) == VIRTUAL

    def note(self, text: str) -> None:
        """Add a remark to the result, and report it."""
        self.notes.append(text)
        self.report(text)

    @contextmanager
    def platform(self, cycle_us: float | None = None, enabled: bool = True) -> Iterator[Robot]:
        """Run a platform in a context, its clocks locked and its drives enabled.

        Raises:
            ExperimentFailed: the clocks do not lock.
            RtcpError: the platform refuses or fails.
        """
        options = StartOptions(config=self.config, bus=self.bus, mode="csp", cycle_us=cycle_us)
        with self.start(options), Robot(f"rtcp experiment (pid {os.getpid()})") as robot:
            until = time.monotonic() + LOCK_TIMEOUT_S
            while (clocks := robot.status().raw["dc"]) is not None and not clocks["locked"]:
                if time.monotonic() > until:
                    raise ExperimentFailed(f"the clocks have not locked within {LOCK_TIMEOUT_S:g} s")
                time.sleep(0.05)
            if enabled:
                robot.enable()
            yield robot

    @contextmanager
    def recording(self, robot: Robot, name: str = "recording", signals: Sequence[str] = ()) -> Iterator[Path]:
        """Record every cycle in a context; yield the file, which is complete afterwards."""
        path = self.folder / f"{name}.mcap"
        pid = robot.record_start(path, signals=signals).pid
        try:
            yield path
        except BaseException:
            with suppress(RtcpError):
                robot.record_stop(pid)
            raise
        for file in robot.record_stop(pid):
            if file.problem or file.missing:
                self.note(f"{name}: {file.problem or f'{file.missing} cycles are missing in the recording'}")

    def draw(self, name: str, figure: Figure) -> None:
        """Save a picture as PNG and SVG; raises OSError."""
        for ending in ("png", "svg"):
            figure.savefig(self.folder / f"{name}.{ending}", dpi=110)
        self.pictures.append(name)

    def with_limits(self, joint: int, **limits: float) -> Setup:
        """Return a setup whose joint (from 0) has at least these limits, on the virtual arm.

        The changed configuration is written to the folder; without need, or with a real arm, nothing changes.
        """
        limited = self.arm.joints[joint]
        raised = {key: value for key, value in limits.items() if getattr(limited, key) < value}
        if not raised or not self.is_virtual:
            return self
        source = find_config(self.config)
        copy = self.folder / "configuration"
        for path in (*source.parent.glob("*.yaml"), *source.parent.glob("devices/*.yaml")):
            target = copy / path.relative_to(source.parent)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, target)
        yaml = YAML()
        document = yaml.load(source)
        document["joints"][joint].update(raised)
        yaml.dump(document, copy / source.name)
        text = ", ".join(f"{key} {value:.3g} instead of {getattr(limited, key):g}" for key, value in raised.items())
        self.note(f"{limited.name} of the virtual arm has other limits for this experiment (configuration/): {text}")
        return replace(self, config=copy / source.name)


def returned(records: npt.NDArray[np.void]) -> npt.NDArray[np.bool_]:
    """Return a mask of the cycles with the expected working counter; the records of others repeat old values."""
    matches: npt.NDArray[np.bool_] = records["wkc"] == records["wkc_expected"]
    return matches


class Experiment(ABC):
    """One experiment; a subclass has `name` and `title`."""

    name = ""
    title = ""

    @abstractmethod
    def run(self, setup: Setup) -> Iterable[Row]:
        """Carry it out and return its figures; one that yields them keeps those before a failure.

        Raises:
            ExperimentFailed: it cannot be carried out or evaluated.
            RtcpError: the platform refuses or fails.
        """


def carry_out(experiment: Experiment, setup: Setup, command: str) -> Result:
    """Carry out an experiment in its folder and write its result, also where it fails.

    Raises:
        ExperimentFailed: it could not be carried out or evaluated.
        RtcpError: the platform refused or failed.
        OSError: the result cannot be written.
    """
    began, begun_s = datetime.now().astimezone(), time.monotonic()
    failure: Exception | None = None
    rows: list[Row] = []
    try:
        rows.extend(experiment.run(setup))  # one by one: the rows before a failure stay
    except (ExperimentFailed, RtcpError) as error:
        failure = error
    except _FAILURES as error:
        failure = ExperimentFailed(str(error))
    if failure is not None:
        rows.append(Row("carried out", "", nan, least=1.0))
        setup.notes.append(str(failure))
    result = Result(
        name=experiment.name,
        title=experiment.title,
        command=command,
        began=began.isoformat(timespec="seconds"),
        seconds=round(time.monotonic() - begun_s, 1),
        host=host(setup),
        rows=tuple(rows),
        pictures=tuple(setup.pictures),
        notes=tuple(setup.notes),
    )
    result.write(setup.folder)
    if failure is not None:
        raise failure
    return result


def host(setup: Setup) -> dict[str, str]:
    """Return the conditions of the figures: machine, versions, arm, bus and cycle."""
    arm = setup.arm
    return {
        "machine": f"{platform.machine()}, {os.cpu_count()} CPUs",
        "system": platform.platform(),
        **versions(),
        "arm": arm.name,
        "bus": setup.bus or arm.bus.interface,
        "period_us": f"{arm.cycle.period_us:g}",
    }
