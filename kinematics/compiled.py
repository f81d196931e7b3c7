"""Which modules run compiled. `make fast` compiles them with mypyc; RTCP_PURE=1 runs the source all the same.

The extension modules and a digest of the sources that they were made of lie in `_fast`. They are used only where all
of these sources are still the same: an edit of one makes all of them run as source.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.abc import MetaPathFinder
from importlib.machinery import EXTENSION_SUFFIXES, ExtensionFileLoader, ModuleSpec
from importlib.util import spec_from_file_location
from pathlib import Path
from types import ModuleType

MANIFEST = "manifest.json"
PURE = "RTCP_PURE"
"""Environment variable; anything but empty and 0 runs the source."""
_FOLDERS = ("config", "control", "devices", "fieldbus", "ipc", "motion", "realtime", "virtual")
DEPENDS_ON = ("kinematics/*.py", *(f"rtcp/{folder}/**/*.py" for folder in _FOLDERS))
"""What a change of makes the compiled code stale: its types are fixed in it, those of interpreted modules too."""
ABI = EXTENSION_SUFFIXES[0]
"""What the files of extension modules for this interpreter end with."""


@dataclass(frozen=True)
class Build:
    """What there is of compiled modules."""

    is_used: bool
    reason: str
    """Why they are not used; empty where they are."""
    is_stale: bool = False
    """They were made of other sources or for another interpreter."""


def sources_digest(root: Path) -> str:
    """Return the digest of all sources that the compiled code was made of, or relies on the types of."""
    found = hashlib.sha256()
    for pattern in DEPENDS_ON:
        for path in sorted(root.glob(pattern)):
            found.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return found.hexdigest()


class _Finder(MetaPathFinder):
    """Finds the compiled modules before their sources."""

    def __init__(self, files: dict[str, Path]) -> None:
        self._files = files

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        file = self._files.get(fullname)
        if file is None:
            return None
        return spec_from_file_location(fullname, file, loader=ExtensionFileLoader(fullname, str(file)))


def is_pure() -> bool:
    """Whether the environment asks for the source."""
    return os.environ.get(PURE, "0") not in ("", "0")


def use(folder: Path) -> Build:
    """Let the modules compiled into a folder be imported where they are those of the sources beside it."""
    if is_pure():
        return Build(False, f"{PURE} is set")
    try:
        manifest = json.loads((folder / MANIFEST).read_text())
        sources, files, abi = str(manifest["sources"]), dict(manifest["files"]), manifest["abi"]
        sizes = {name: (folder / name).stat().st_size for name in files.values()}
    except FileNotFoundError as error:
        if Path(str(error.filename)).name == MANIFEST:
            return Build(False, "not compiled: `make fast` compiles it")
        return Build(False, f"{error.filename} is missing: run `make fast`", is_stale=True)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        return Build(False, f"{folder / MANIFEST} cannot be read ({error}): run `make fast`", is_stale=True)
    if abi != ABI:
        return Build(False, f"compiled for {abi}, this interpreter needs {ABI}: run `make fast`", is_stale=True)
    if sizes != manifest.get("sizes") or sources_digest(folder.parent.parent) != sources:
        return Build(False, "the source has changed since it was compiled: run `make fast`", is_stale=True)
    finder = _Finder({name: folder / file for name, file in files.items()})
    sys.meta_path.insert(0, finder)
    try:
        for name in files:
            if name.endswith("__mypyc"):
                import_module(name)
    except ImportError as error:
        sys.meta_path.remove(finder)
        return Build(False, f"the compiled code cannot be loaded ({error}): run `make fast`", is_stale=True)
    return Build(True, "")


BUILD = use(Path(__file__).parent / "_fast")
"""What this process runs."""
