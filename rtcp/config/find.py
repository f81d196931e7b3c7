"""Finds the arm's file, and the classes that installed packages, this one among them, register."""

from __future__ import annotations

import contextlib
import inspect
import os
import traceback
from collections.abc import Iterator
from functools import cache
from importlib.metadata import EntryPoint, EntryPoints, entry_points
from pathlib import Path
from typing import TypeVar

from rtcp.config.findings import Finding
from rtcp.config.model import ConfigError, PluginError

T = TypeVar("T")

SYSTEM = Path("/etc/rtcp/assistive_arm.yaml")
"""The configuration of this machine."""

ENVIRONMENT = "RTCP_CONFIG"
"""The environment variable that names the arm's file."""


def find_config(path: Path | None = None) -> Path:
    """Return the arm's file: `path`, else $RTCP_CONFIG, else /etc/rtcp/assistive_arm.yaml, else the default.

    Raises:
        ConfigError: the requested file does not exist, or the package lacks its default.
    """
    if path is not None:
        return _there(path, "--config")
    if named := os.environ.get(ENVIRONMENT):
        return _there(Path(named), ENVIRONMENT)
    if exists(SYSTEM):
        return SYSTEM
    return default_config()


def find_arm(arm: str | None = None) -> Path:
    """Return the file of an arm to compute with: a path, or the bare name of a file beside the default configuration.

    None: the arm's file of `find_config`.

    Raises:
        ConfigError: there is no such file; for a bare name the message lists the arms.
    """
    if arm is None:
        return find_config()
    path = Path(arm)
    if exists(path) or path.name != arm or path.suffix:
        return _there(path, "--arm")
    folder = default_config().parent
    named = folder / f"{arm}.yaml"
    if exists(named):
        return named
    known = sorted(file.stem for file in folder.glob("*.yaml") if "\nkinematics:" in file.read_text(encoding="utf-8"))
    text = f"--arm {arm}: there is no such file, and no arm of this name; known are {', '.join(known)}"
    raise ConfigError([text], "no_file")


def default_config() -> Path:
    """Return the arm's file that came with the package: in a wheel inside it, in a checkout beside it.

    Raises:
        ConfigError: it is in neither place.
    """
    package = Path(__file__).resolve().parent.parent
    places = (package / "config" / "default" / SYSTEM.name, package.parent / "config" / SYSTEM.name)
    for place in places:
        if place.is_file():
            return place
    raise ConfigError(
        [f"the default configuration is missing; it belongs at {' or '.join(map(str, places))}"], "no_default"
    )


def exists(path: Path) -> bool:
    """Return whether there is such a file, also if it cannot be read: reading it then says why."""
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError:
        return True
    return True


def _there(path: Path, asked_by: str) -> Path:
    if os.path.isdir(path):
        raise ConfigError(
            [f"{path}, named by {asked_by}, is a directory; name the arm's file in it"], "no_regular_file"
        )
    if not exists(path):
        raise ConfigError([f"{path}, named by {asked_by}, does not exist; name the arm's file"], "no_file")
    return path


@cache
def installed(group: str) -> EntryPoints:
    """Return the entry points of a group, cached: a lookup reads the metadata of every installed package."""
    return entry_points(group=group)


def registered(group: str) -> dict[str, EntryPoint]:
    """Return the entry points that installed packages registered in a group, by name.

    Raises:
        PluginError: two packages use the same name.
        ConfigError: there is none, although this package registers some.
    """
    entries: dict[str, EntryPoint] = {}
    for entry in sorted(installed(group)):
        first = entries.setdefault(entry.name, entry)
        if first.value != entry.value:
            raise PluginError(entry, f"has the name of {first.value}: rename one, or uninstall its package")
    if not entries:
        raise ConfigError(
            [f"no entry points {group}: the package is older than its metadata; run `make setup`"], "no_plugins"
        )
    return entries


def class_of_kind(base: type[T], group: str, kind: str) -> type[T]:
    """Return the class that is registered in a group of entry points for a kind.

    Raises:
        ConfigError: no installed package has this kind.
        PluginError: the registered class does not extend `base`.
    """
    kinds = registered(group)
    if kind not in kinds:
        raise ConfigError([Finding(("kind",), "choice", found=kind, allowed=f"one of {', '.join(sorted(kinds))}")])
    return load_class(kinds[kind], base)


def load_messages() -> None:
    """Import the controllers and drivers of other packages: that registers their commands, refusals and events.

    Raises:
        PluginError: one cannot be imported.
    """
    for group in ("rtcp.controllers", "rtcp.devices"):
        for entry in installed(group):
            if not entry.value.startswith("rtcp."):
                load_class(entry, object)


def is_foreign(made: object) -> bool:
    """Return whether an object is of a class of another package."""
    return not type(made).__module__.startswith("rtcp.")


@contextlib.contextmanager
def made_by(entry: EntryPoint) -> Iterator[None]:
    """Make an object of a plug-in's class: what it raises is a finding about the plug-in, with file and line.

    Raises:
        PluginError: it raised another exception than a ValueError on its configuration.
    """
    try:
        yield
    except (KeyboardInterrupt, ConfigError):
        raise
    except BaseException as error:  # whatever it raises, sys.exit() too
        if isinstance(error, ValueError) and type(error) is not ValueError:
            raise  # a finding of its own kind, as DeviceError and SchemaError
        frame = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{frame.filename}, line {frame.lineno}"
        raise PluginError(entry, f"cannot be used: {type(error).__name__}: {error} ({where})") from error


def plugin_error(error: BaseException) -> BaseException:
    """Return what the code of a plug-in raised, sys.exit() and asyncio.CancelledError too.

    Raises:
        KeyboardInterrupt: the error is that one, which a person raised.
    """
    if isinstance(error, KeyboardInterrupt):
        raise error
    return error


def definition_of(kind: type[object]) -> str:
    """Return the file and the line of a plug-in's class, for a finding about it."""
    try:
        return f"{inspect.getsourcefile(kind)}, line {inspect.getsourcelines(kind)[1]}"
    except (OSError, TypeError):
        return f"{kind.__module__}.{kind.__qualname__}, which has no source file"


def load_class(entry: EntryPoint, base: type[T]) -> type[T]:
    """Return the class of an entry point.

    Raises:
        PluginError: it cannot be imported, or does not extend `base`.
    """
    try:
        loaded = entry.load()
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # the module of another package: whatever it raises, sys.exit() too
        raise PluginError(entry, f"cannot be loaded: {type(error).__name__}: {error}") from error
    if not (isinstance(loaded, type) and issubclass(loaded, base)):
        raise PluginError(entry, f"is not a subclass of {base.__module__}.{base.__name__}")
    return loaded
