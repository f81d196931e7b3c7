"""Compiles the cycle with mypyc: in place (`make fast`), and for a wheel, which hatchling has this hook for.

What is compiled is the source as it is; `kinematics.compiled` decides at run time whether it is used.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import sysconfig
import tempfile
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

ROOT = Path(__file__).resolve().parent
COMPILED = (
    "kinematics/*.py",
    "rtcp/control/*.py",
    "rtcp/devices/*.py",
    "rtcp/motion/*.py",
    "rtcp/motion/controllers/*.py",
    "rtcp/motion/guards/*.py",
    "rtcp/motion/planning/*.py",
    "rtcp/fieldbus/process_data.py",
    "rtcp/fieldbus/system_time.py",
    "rtcp/ipc/blackboard.py",
    "rtcp/ipc/layout.py",
    "rtcp/realtime/discipline.py",
    "rtcp/virtual/al_state.py",
    "rtcp/virtual/distributed_clock.py",
    "rtcp/virtual/esc.py",
    "rtcp/virtual/fmmu.py",
    "rtcp/virtual/mailbox.py",
    "rtcp/virtual/objects.py",
    "rtcp/virtual/pdo.py",
    "rtcp/virtual/segment.py",
    "rtcp/virtual/slave.py",
    "rtcp/virtual/wire.py",
    "rtcp/virtual/models/cyclic_modes.py",
    "rtcp/virtual/models/mechanics.py",
    "rtcp/virtual/models/profile_modes.py",
    "rtcp/virtual/models/protection.py",
    "rtcp/virtual/models/servo.py",
    "rtcp/virtual/models/units.py",
    "rtcp/testing/bus.py",
    "rtcp/testing/sessions/checker.py",
    "rtcp/testing/sessions/mechanics.py",
    "rtcp/testing/sessions/oracle.py",
)
INTERPRETED = (
    "kinematics/c_source.py",
    "kinematics/compiled.py",
    "kinematics/model.py",
    "kinematics/pose.py",
    "kinematics/urdf.py",
    "rtcp/control/bus_service.py",
    "rtcp/control/process.py",
    "rtcp/control/sdo_requests.py",
    "rtcp/motion/planning/trajectories.py",
    "rtcp/motion/planning/lines.py",
)
"""Files of these folders that no cycle runs, and two that need what the compiler takes away: `model.py` the refusal of
vectors of another length, `pose.py` the types of its fields, by which a session is read."""


NOT_POSSIBLE = 2
"""Exit code where this machine has no compiler."""


def sources() -> list[str]:
    """Return the files that are compiled, from the repository's root."""
    found = {str(path.relative_to(ROOT)) for pattern in COMPILED for path in ROOT.glob(pattern)}
    return sorted(name for name in found - set(INTERPRETED) if not name.endswith("__init__.py"))


def _compiled() -> Any:
    """Return `kinematics.compiled`, by its path: a build of a wheel has no project on its path."""
    spec = spec_from_file_location("compiled", ROOT / "kinematics" / "compiled.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    sys.modules["compiled"] = module  # dataclasses look there
    spec.loader.exec_module(module)
    return module


def build(target: Path) -> None:
    """Compile into `target`: extension modules and the manifest. What was there stays until all is made.

    Raises:
        SystemExit: mypyc refuses a source.
        setuptools.errors.BaseError: the compiler does.
        RuntimeError: a source was changed meanwhile.
    """
    from mypyc.build import mypycify
    from setuptools import Distribution
    from setuptools.command.build_ext import build_ext

    class ParallelBuild(build_ext):
        """Runs the C compiler on every CPU: setuptools compiles the sources of an extension one after the other."""

        def build_extensions(self) -> None:
            compile_all: Any = self.compiler.compile

            def compile_each(sources: list[str], **options: Any) -> list[str]:
                with ThreadPoolExecutor(os.cpu_count()) as pool:
                    compiled_each = pool.map(lambda source: compile_all([source], **options), sources)
                    return [name for names in compiled_each for name in names]

            self.compiler.compile = compile_each
            super().build_extensions()

    compiled = _compiled()
    os.chdir(ROOT)
    before = compiled.sources_digest(ROOT)
    fresh = target.with_name(f"{target.name}.new")
    shutil.rmtree(fresh, ignore_errors=True)
    fresh.mkdir(parents=True)
    with tempfile.TemporaryDirectory() as scratch:
        options = ["--ignore-missing-imports", *sources()]
        extensions = mypycify(options, opt_level="2", multi_file=True, target_dir=f"{scratch}/c")
        for extension in extensions:
            # No fused multiplication and addition, as on aarch64: results are those of the interpreter, to the bit.
            extension.extra_compile_args = [*extension.extra_compile_args, "-ffp-contract=off"]
        command: Any = ParallelBuild(Distribution({"name": "rtcp", "ext_modules": extensions}))
        command.build_lib, command.build_temp = f"{scratch}/lib", f"{scratch}/tmp"
        command.ensure_finalized()
        command.run()
        files = {extension.name: f"{extension.name}{compiled.ABI}" for extension in extensions}
        for name, file in files.items():
            shutil.copy(command.get_ext_fullpath(name), fresh / file)
    if compiled.sources_digest(ROOT) != before:
        raise RuntimeError("a source was changed while it was compiled: compile again")
    sizes = {file: (fresh / file).stat().st_size for file in files.values()}
    manifest = {"abi": compiled.ABI, "files": files, "sizes": sizes, "sources": before}
    (fresh / compiled.MANIFEST).write_text(json.dumps(manifest, indent=1))
    if target.exists():
        # The manifest first: without it nothing of a folder is used.
        (target / compiled.MANIFEST).unlink(missing_ok=True)
        shutil.rmtree(target)
    fresh.rename(target)


def missing() -> str:
    """Return what is missing to compile; empty where nothing is."""
    compiler = (sysconfig.get_config_var("CC") or "cc").split()[0]
    if shutil.which(compiler) is None:
        return f"a C compiler: there is no {compiler} (Debian, Ubuntu: apt install gcc)"
    header = Path(sysconfig.get_paths()["include"]) / "Python.h"
    if not header.exists():
        return f"Python's headers: there is no {header} (Debian, Ubuntu: apt install python3-dev)"
    for package in ("mypyc", "setuptools"):
        if find_spec(package) is None:
            return f"the package {package} (pip install mypy setuptools)"
    return ""


class CompileHook(BuildHookInterface[Any]):
    """Puts the compiled modules into a wheel; without a compiler the wheel has the source alone, for any machine."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile, but for an editable install, and where RTCP_PURE is set."""
        if version == "editable" or _compiled().is_pure():
            return
        if lack := missing():
            self.app.display_warning(f"not compiled, for want of {lack}")
            return
        self._scratch = tempfile.TemporaryDirectory(prefix="rtcp-wheel-")
        target = Path(self._scratch.name) / "fast"
        try:
            build(target)
        except (Exception, SystemExit) as error:
            self.app.display_warning(f"not compiled: {error}")
            return
        build_data["force_include"][str(target)] = "kinematics/_fast"
        build_data["pure_python"] = False
        build_data["infer_tag"] = True


def main() -> int:
    """Compile in place."""
    if lack := missing():
        sys.stderr.write(f"not compiled, for want of {lack}; everything runs as source\n")
        return NOT_POSSIBLE
    target = ROOT / "kinematics" / "_fast"
    if not os.access(target.parent, os.W_OK):
        sys.stderr.write(f"not compiled: {target.parent} cannot be written; everything runs as source\n")
        return NOT_POSSIBLE
    build(target)
    return 0


if __name__ == "__main__":
    sys.exit(main())
