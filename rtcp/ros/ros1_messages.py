"""ROS 1 from Debian's packages on our interpreter, and the message classes that Debian does not have.

The definitions are in the folder `messages`. Debian's own generators make Python classes from them, once, into a folder
of the user's cache; the MD5 sums that ROS computes from a definition prove that they are the types that others speak.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

DEFINITIONS = Path(__file__).parent / "messages"
PACKAGES = (
    "python3-rospy python3-rosmaster python3-actionlib python3-genpy python3-sensor-msgs python3-trajectory-msgs "
    "python3-std-srvs python3-diagnostic-msgs python3-tf2-msgs libactionlib-msgs-dev ros-std-msgs ros-geometry-msgs "
    "ros-trajectory-msgs ros-actionlib-msgs"
)
"""Debian 12 packages that the node needs."""
_DEBIAN_PYTHON = "/usr/bin/python3"
"""The generators import Debian's genpy, which another interpreter does not find."""
_DIST_PACKAGES = Path("/usr/lib/python3/dist-packages")
_GENACTION = Path("/usr/lib/actionlib_msgs/genaction.py")
_GENPY = Path("/usr/lib/genpy")
_SHARE = Path("/usr/share")
_USED = ("std_msgs", "geometry_msgs", "trajectory_msgs", "actionlib_msgs")
"""Packages whose definitions ours refer to."""
_NEEDED = (_DIST_PACKAGES / "rospy", _DIST_PACKAGES / "actionlib", _DIST_PACKAGES / "sensor_msgs",
           _DIST_PACKAGES / "trajectory_msgs", _DIST_PACKAGES / "std_srvs", _DIST_PACKAGES / "diagnostic_msgs",
           _DIST_PACKAGES / "tf2_msgs", _GENACTION, _GENPY, *(_SHARE / name / "msg" for name in _USED))  # fmt: skip


class RosMissing(Exception):
    """ROS 1 is not installed, or its generators failed; the message says what to do."""


def missing() -> str:
    """Return a sentence on the missing part of ROS 1 and how to install it; empty: nothing is missing."""
    for path in _NEEDED:
        if not path.exists():
            return f"ROS 1 is not installed ({path} is missing): apt install {PACKAGES}"
    return ""


def make_importable() -> None:
    """Put ROS 1 and our own messages at the end of `sys.path`, where our own packages come first.

    If rospy can be imported already, from a sourced ROS environment, that one is used.

    Raises:
        RosMissing: it is not installed, or the classes cannot be generated.
    """
    if importlib.util.find_spec("rospy") is None:
        if problem := missing():
            raise RosMissing(problem)
        sys.path.append(str(_DIST_PACKAGES))
    if importlib.util.find_spec("industrial_msgs") is None or importlib.util.find_spec("control_msgs") is None:
        sys.path.append(str(generated()))


def cache_directory() -> Path:
    """Return where generated code is kept: `rtcp` in the user's cache (XDG)."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rtcp"


def generated() -> Path:
    """Return the folder with the packages control_msgs and industrial_msgs; generate them where it is not there yet.

    Raises:
        RosMissing: the generators are not installed, or failed.
    """
    sources = sorted(path for path in DEFINITIONS.rglob("*.*") if path.suffix in (".msg", ".srv", ".action"))
    digest = hashlib.sha256(b"".join(path.name.encode() + path.read_bytes() for path in sources)).hexdigest()[:12]
    folder = cache_directory() / f"ros1-messages-{digest}"
    if folder.exists():
        return folder
    if problem := missing():
        raise RosMissing(problem)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent) as scratch:
        package = Path(scratch) / "python"
        _generate(Path(scratch), package)
        try:
            package.rename(folder)  # whole or not at all, also where two processes do it at once
        except OSError:
            if not folder.exists():
                raise
    return folder


def _generate(scratch: Path, out: Path) -> None:
    """Write the Python packages into `out`."""
    actions = scratch / "action_messages"
    _run(_GENACTION, DEFINITIONS / "control_msgs/action/FollowJointTrajectory.action", "-o", actions)
    shutil.copy(DEFINITIONS / "control_msgs/msg/JointTolerance.msg", actions)
    industrial = DEFINITIONS / "industrial_msgs"
    places = {"control_msgs": actions, "industrial_msgs": industrial / "msg"}
    places |= {name: _SHARE / name / "msg" for name in _USED}
    include = [word for name, place in places.items() for word in ("-I", f"{name}:{place}")]
    for package, kind, generator, files in (
        ("control_msgs", "msg", "genmsg_py.py", actions.glob("*.msg")),
        ("industrial_msgs", "msg", "genmsg_py.py", (industrial / "msg").glob("*.msg")),
        ("industrial_msgs", "srv", "gensrv_py.py", (industrial / "srv").glob("*.srv")),
    ):
        folder = out / package / kind
        folder.mkdir(parents=True)
        _run(_GENPY / generator, "-p", package, *include, "-o", folder, *sorted(files))
        _run(_GENPY / "genmsg_py.py", "--initpy", "-p", package, "-o", folder)
        (out / package / "__init__.py").touch()


def _run(generator: Path, *arguments: str | Path) -> None:
    process = subprocess.run([_DEBIAN_PYTHON, generator, *arguments], capture_output=True, text=True, check=False)
    if process.returncode:
        raise RosMissing(
            f"{generator} failed: {(process.stderr or process.stdout).strip()}: reinstall its Debian package"
        )
