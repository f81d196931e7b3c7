"""Which modules run compiled. `make fast` compiles them with mypyc; RTCP_PURE=1 runs the source all the same.

The folder `_fast` holds the extension modules and a digest of the sources that they were made from. They are used only
while all of these sources are unchanged: after an edit of one, all modules run as source.
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
_FOLDERS = ("config", "control", "devices", "fieldbus", "ipc", "motion", "realtime", "testing", "virtual")
DEPENDS_ON = ("kinematics/*.py", *(f"rtcp/{folder}/**/*.py" for folder in _FOLDERS))
"""Files whose change makes the compiled code stale: it has their types built in, also those of interpreted modules."""
ABI = EXTENSION_SUFFIXES[0]
"""File name suffix of extension modules for this interpreter."""


@dataclass(frozen=True)
class Build:
    """State of the compiled modules in this process."""

    is_used: bool
    reason: str
    """Why they are not used; empty if they are."""
    is_stale: bool = False
    """Whether they were made from other sources, for another interpreter, or are damaged."""


def sources_digest(root: Path) -> str:
    """Return the digest of the sources on which the compiled code depends."""
    digest = hashlib.sha256()
    for pattern in DEPENDS_ON:
        for path in sorted(root.glob(pattern)):
            digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


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
    """Import the compiled modules in `folder` from now on, if they were made from the present sources."""
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
"""State of the compiled modules in this process."""
