"""Motion files with a program that is taught: each change is checked whole, written at once, and can be undone.

Comments and layout of the file stay.
"""

from __future__ import annotations

import contextlib
import fcntl
import io
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq

from rtcp.config.document import parse, text_of
from rtcp.config.findings import Finding
from rtcp.config.model import ConfigError, MotionFile
from rtcp.config.motion_file import check

_DIGITS: Final = 6
"""Decimals of a kept position: 1 um, 1 urad."""
_LONGEST_LINE: Final = 1 << 16
_MOST_UNDONE: Final = 100


class ProgramFile:
    """A motion file that is taught; the file may not exist yet.

    Every method that makes a change raises ConfigError, and changes nothing, if the result would have a mistake, the
    file cannot be written, or another program has changed it meanwhile (`reload` reads it again).

    Args:
        path: of the file, in YAML.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if self.path.suffix.lower() not in (".yaml", ".yml"):
            raise ConfigError([f"{self.path}: a program is kept in a file that ends in .yaml or .yml"], "ending")
        self._undo: list[str] = []
        """Texts before the last changes; none from before `reload`."""
        self.motion = MotionFile()
        """Content of the file."""
        self._text = ""
        self.reload()

    def reload(self) -> None:
        """Read the file again; raises ConfigError if it has mistakes or holds a trajectory or a path."""
        text = self._on_disk()
        self.motion = self._checked(text)
        self._text = text
        self._undo.clear()

    @property
    def can_undo(self) -> bool:
        """Whether there is a change to undo."""
        return bool(self._undo)

    def undo(self) -> None:
        """Undo the last change."""
        if self._undo:
            self._check_unchanged()
            self._write(self._undo[-1])
            self._undo.pop()

    def keep(self, name: str, q: Sequence[float] | None = None, pose: Sequence[float] | None = None) -> None:
        """Keep joint positions, rad, or a pose of the tool, m and rad, under a name; replaces an entry of this name."""
        data = self._data()
        poses = _list_in(data, "poses")
        entry: dict[str, Any] = {"name": name}
        entry |= {
            key: [round(float(number), _DIGITS) + 0.0 for number in value]
            for key, value in (("q", q), ("pose", pose))
            if value is not None
        }
        at = next((at for at, kept in enumerate(poses) if kept.get("name") == name), None)
        if at is None:
            poses.append(_on_one_line(entry))
        else:
            poses[at] = _on_one_line(entry)
        self._change(data)

    def remove_pose(self, name: str) -> None:
        """Remove a pose that no step names."""
        data = self._data()
        poses = _list_in(data, "poses")
        del poses[_index(self.path, [pose.get("name") for pose in poses], name, "poses")]
        self._change(data)

    def set_speed(self, speed: float | None) -> None:
        """Set the speed of the tool, m/s; None: that of the arm's file."""
        data = self._data()
        data.pop("speed", None)
        if speed is not None:
            data.insert(0, "speed", speed)
        self._change(data)

    def insert(self, at: int, step: Mapping[str, Any], part: str = "") -> None:
        """Insert a step (`docs/motion.md`) before the one at `at`, from 0, of the program or of a part."""
        data = self._data()
        steps = self._steps(data, part)
        if at == len(steps):
            steps.append(_on_one_line(step))
        else:
            steps.insert(self._at(steps, at), _on_one_line(step))
        self._change(data)

    def replace(self, at: int, step: Mapping[str, Any], part: str = "") -> None:
        """Replace a step."""
        data = self._data()
        steps = self._steps(data, part)
        steps[self._at(steps, at)] = _on_one_line(step)
        self._change(data)

    def remove(self, at: int, part: str = "") -> None:
        """Delete a step."""
        data = self._data()
        steps = self._steps(data, part)
        del steps[self._at(steps, at)]
        self._change(data)

    def move(self, at: int, to: int, part: str = "") -> None:
        """Move a step to the place of another; that step and those between shift by one."""
        data = self._data()
        steps = self._steps(data, part)
        step, comment = steps[self._at(steps, at)], steps.ca.items.get(at)
        self._at(steps, to)
        del steps[at]
        steps.insert(to, step)
        if comment is not None:
            steps.ca.items[to] = comment
        self._change(data)

    def _steps(self, data: CommentedMap, part: str) -> CommentedSeq:
        if not part:
            return _list_in(data, "program")
        parts = _list_in(data, "parts")
        return _list_in(parts[_index(self.path, [entry.get("name") for entry in parts], part, "parts")], "steps")

    def _at(self, steps: CommentedSeq, at: int) -> int:
        if not 0 <= at < len(steps):
            raise ConfigError([Finding((), "no_step", found=at + 1, allowed=f"1 to {len(steps)}").at(self.path)])
        return at

    def _on_disk(self) -> str:
        return text_of(self.path) if self.path.exists() else ""

    def _checked(self, text: str) -> MotionFile:
        if not text.strip():
            return MotionFile()
        motion = check(parse(text, self.path))
        if motion.trajectory or motion.path:
            kind = "trajectory" if motion.trajectory else "path"
            raise ConfigError([f"{self.path}: it holds a {kind}, allowed is a program"], "no_program")
        return motion

    def _check_unchanged(self) -> None:
        if self._on_disk() != self._text:
            raise ConfigError([f"{self.path}: something else has changed the file meanwhile: read it again"], "changed")

    def _data(self) -> CommentedMap:
        self._check_unchanged()
        data = _yaml().load(self._text) if self._text.strip() else None
        return CommentedMap() if data is None else data

    def _change(self, data: CommentedMap) -> None:
        written = io.StringIO()
        _yaml().dump(data, written)
        before = self._text
        self._write(written.getvalue() if data else "")
        self._undo = [*self._undo, before][-_MOST_UNDONE:]

    def _write(self, text: str) -> None:
        """Replace the file as a whole, or not at all."""
        motion = self._checked(text)
        try:
            # A symbolic link stays: its target is replaced.
            path = self.path.resolve()
            path.parent.mkdir(parents=True, exist_ok=True)
            with _locked(path.parent):
                # Checked again, under the lock: another process may have written since the change began.
                self._check_unchanged()
                self._replace_by(path, text)
        except (OSError, RuntimeError) as error:
            reason = error.strerror if isinstance(error, OSError) else str(error)
            raise ConfigError([f"{self.path}: the file cannot be written: {reason}"], "unwritable") from error
        self.motion, self._text = motion, text

    @staticmethod
    def _replace_by(path: Path, text: str) -> None:
        temporary = None
        try:
            mode = path.stat().st_mode & 0o777 if path.exists() else 0o644
            handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
            with os.fdopen(handle, "w", encoding="utf-8") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            Path(temporary).chmod(mode)
            os.replace(temporary, path)
        except OSError:
            if temporary is not None:
                with contextlib.suppress(OSError):
                    os.unlink(temporary)
            raise


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder: other processes that teach in it wait."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _yaml() -> YAML:
    """Return a reader and writer that keeps comments, with lists indented as in `docs/motion.md`."""
    yaml = YAML()
    yaml.preserve_quotes = True
    yaml.width = _LONGEST_LINE
    yaml.indent(mapping=2, sequence=4, offset=2)
    return yaml


def _list_in(data: CommentedMap, key: str) -> CommentedSeq:
    """Return the list of a key; adds it if it is missing."""
    if data.get(key) is None:
        data[key] = CommentedSeq()
    entries: CommentedSeq = data[key]
    if not len(entries):
        entries.fa.set_block_style()
    return entries


def _on_one_line(entry: Mapping[str, Any]) -> CommentedMap:
    line = CommentedMap()
    for key, value in entry.items():
        if isinstance(value, list | tuple):
            value = CommentedSeq(value)  # noqa: PLW2901
            value.fa.set_flow_style()
        line[key] = value
    line.fa.set_flow_style()
    return line


def _index(path: Path, names: Sequence[str], name: str, key: str) -> int:
    if name not in names:
        finding = Finding((key,), "choice", found=name, allowed=f"one of {', '.join(names) or 'none'}")
        raise ConfigError([finding.at(path)])
    return names.index(name)
