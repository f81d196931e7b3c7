"""The order of imports (design: "The house"), read from the sources, and the modules that the loop's process loads."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]
ORDER = (
    ("kinematics",), ("esi",), ("config",), ("virtual",), ("ipc",), ("fieldbus",), ("devices",), ("api",), ("motion",),
    ("realtime",), ("control",), ("processes",), ("gateway",), ("launch", "testing"), ("telemetry", "gym"),
    ("panel", "ros"), ("cli",),
)  # fmt: skip
"""Folders from top to bottom; each imports itself and those above, not those beside it."""
EXCEPTIONS: dict[tuple[str, str], str] = {}
"""(file, module) -> why it may import what stands below it or beside it. """
NEVER_IN_THE_LOOP = {"pydantic", "pydantic_core", "typer", "rich", "pyroute2", "yaml", "ruamel", "mcap", "foxglove",
                     "matplotlib"}  # fmt: skip
IN_THE_LOOP = {"annotated_types", "mypy_extensions", "pysoem", "ruckig"}
"""Third-party modules of the loop's process. numpy may be among them by the design, but its threads would keep the
process from joining the virtual segment's user namespace, so it is not."""
LET_IN_BY_OTHERS = {"typing_extensions"}
"""annotated_types imports it where it is installed."""

ROS = {"actionlib", "control_msgs", "diagnostic_msgs", "geometry_msgs", "industrial_msgs", "rosgraph", "rospy",
       "sensor_msgs", "std_msgs", "std_srvs", "tf2_msgs", "trajectory_msgs"}  # fmt: skip
ROS_FILES = {"rtcp/ros/ros1.py", "rtcp/ros/ros1_latency.py"}
"""Modules of ROS 1: Debian's, or generated. The node and the client that measures it import them, once
`rtcp.ros.ros1_messages` has found them."""

ROS_2 = {
    "rtcp/ros/ros2_types.py": {"rosbags"},
    "rtcp/ros/ros2_zenoh.py": {"zenoh"},
    "rtcp/ros/ros2_dds.py": {"cyclonedds"},
    "rtcp/ros/ros2_rclpy.py": {"rcl_interfaces", "rclpy"},
    "rtcp/ros/latency.py": {"cyclonedds"},
}
"""Modules of optional dependencies, and of a ROS 2 that is installed otherwise: by the files that import them."""

ABB = {"rtcp/virtual/irc5/messages.py": {"google"}, "rtcp/fieldbus/egm.py": {"google"}}
"""Modules of the optional dependency `abb`, by the files that import them."""

CLUSTER = {"rtcp/testing/sessions/cluster.py": {"dask", "distributed", "pyarrow"}}
"""Modules of the optional dependency `cluster`, by the files that import them."""

GYM = {"rtcp/gym/__init__.py": {"gymnasium"}, "rtcp/gym/environment.py": {"gymnasium"}}
"""Modules of the optional dependency `gym`, by the files that import them."""

PACKAGES = {
    "foxglove": "foxglove_sdk",
    "yaml": "pyyaml",
    "pydantic_core": "pydantic",
    "ruamel": "ruamel.yaml",
    "mpl_toolkits": "matplotlib",
}
"""Modules whose package has another name."""


class Import(NamedTuple):
    """One module that a file imports, at any place in the file."""

    file: str
    line: int
    module: str

    @property
    def importer(self) -> str:
        return place_of(".".join(Path(self.file).with_suffix("").parts))

    @property
    def imported(self) -> str:
        return place_of(self.module)


def place_of(module: str) -> str:
    """The folder of the house in which a module stands: `config` for rtcp.config.model, `rtcp` for the package."""
    parts = module.split(".")
    if parts[0] != "rtcp" or parts[1:] in ([], ["__init__"]):
        return parts[0]
    return parts[1]


def modules_named(statement: ast.Import | ast.ImportFrom, package: str) -> list[str]:
    """The absolute names of the modules that an import statement of a file in `package` names."""
    if isinstance(statement, ast.Import):
        return [alias.name for alias in statement.names]
    module = statement.module or ""
    if statement.level:
        parts = package.split(".")[: len(package.split(".")) - statement.level + 1]
        module = ".".join([*parts, module] if module else parts)
    # `from rtcp import cli` names a module behind the word import, `from rtcp import __version__` does not.
    behind = [alias.name for alias in statement.names if module == "rtcp" and not alias.name.startswith("__")]
    return [module, *(f"{module}.{name}" for name in behind)]


@cache
def statements(path: Path) -> list[ast.Import | ast.ImportFrom]:
    nodes = ast.walk(ast.parse(path.read_text(), str(path)))
    return [node for node in nodes if isinstance(node, ast.Import | ast.ImportFrom)]


def imports_of(root: Path) -> Iterator[Import]:
    for path in sorted([*root.glob("rtcp/**/*.py"), *root.glob("kinematics/**/*.py")]):
        file = path.relative_to(root)
        for statement in statements(path):
            for module in modules_named(statement, ".".join(file.parent.parts)):
                yield Import(str(file), statement.lineno, module)


def is_ours(statement: Import) -> bool:
    return statement.module.partition(".")[0] in ("rtcp", "kinematics")


def breaks_the_order(statement: Import) -> bool:
    """Whether it names a folder below or beside the importer's, or one that is not in the list."""
    rank = {folder: at for at, folders in enumerate(ORDER) for folder in folders}
    if statement.imported in (statement.importer, "rtcp") or (statement.importer, statement.imported) in (
        ("rtcp", "api"),
        ("rtcp", "kinematics"),
    ):
        return False
    if statement.importer not in rank or statement.imported not in rank:
        return True
    return rank[statement.imported] >= rank[statement.importer]


@cache
def all_imports() -> list[Import]:
    return list(imports_of(ROOT))


def sentences(breaches: list[Import]) -> list[str]:
    return [f"{breach.file}:{breach.line} imports {breach.module}" for breach in breaches]


# -- what the sources say -------------------------------------------------------------------------------------------


def test_every_folder_of_the_house_stands_in_the_list() -> None:
    listed = {folder for folders in ORDER for folder in folders}
    present = {path.name for path in (ROOT / "rtcp").iterdir() if (path / "__init__.py").exists()}
    assert present <= listed


def test_every_module_but_the_packages_own_lies_in_a_folder() -> None:
    assert [path.name for path in (ROOT / "rtcp").glob("*.py")] == ["__init__.py"]


def test_a_folder_imports_only_folders_above_it() -> None:
    breaches = [
        imported
        for imported in all_imports()
        if is_ours(imported) and breaks_the_order(imported) and (imported.file, imported.module) not in EXCEPTIONS
    ]
    assert sentences(breaches) == []


def test_no_file_imports_itself_by_way_of_others() -> None:
    paths = {path for imported in all_imports() if (path := ROOT / imported.file).name != "__init__.py"}
    modules = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in paths}
    graph: dict[Path, set[Path]] = {}
    for path in paths:
        for statement in statements(path):
            named = modules_named(statement, "")
            if isinstance(statement, ast.ImportFrom):
                named += [f"{statement.module}.{alias.name}" for alias in statement.names]
            graph.setdefault(path, set()).update(modules[name] for name in named if name in modules)
    TopologicalSorter(graph).prepare()  # CycleError names the files


def test_every_exception_is_still_needed() -> None:
    breaches = {
        (imported.file, imported.module)
        for imported in all_imports()
        if is_ours(imported) and breaks_the_order(imported)
    }
    assert set(EXCEPTIONS) <= breaches


def test_the_package_itself_names_the_api_and_loads_no_more_than_kinematics() -> None:
    named = {imported.module for imported in all_imports() if imported.file == "rtcp/__init__.py" and is_ours(imported)}
    assert named == {"rtcp.api", "kinematics.compiled"}
    program = "import sys, rtcp; print([name for name in sys.modules if name.startswith('rtcp.')])"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_nothing_imports_cli() -> None:
    assert sentences([each for each in all_imports() if each.imported == "cli" and each.importer != "cli"]) == []


@pytest.mark.parametrize(
    ("importer", "imported"),
    [("virtual", "fieldbus"), ("virtual", "devices"), ("fieldbus", "virtual"), ("devices", "virtual")],
)
def test_the_two_sides_of_the_wire_share_no_code(importer: str, imported: str) -> None:
    assert sentences([each for each in all_imports() if (each.importer, each.imported) == (importer, imported)]) == []


def test_virtual_imports_nothing_of_ours_but_config_esi_and_kinematics() -> None:
    allowed = {"rtcp", "virtual", "config", "esi", "kinematics"}
    imported = [each for each in all_imports() if each.importer == "virtual" and is_ours(each)]
    assert sentences([each for each in imported if each.imported not in allowed]) == []


def test_the_loops_side_does_not_import_virtual() -> None:
    sides = ("fieldbus", "devices", "ipc", "motion", "realtime", "control", "gateway")
    assert sentences([each for each in all_imports() if each.imported == "virtual" and each.importer in sides]) == []


def test_devices_and_kinematics_know_nothing_of_motion() -> None:
    assert (
        sentences([f for f in all_imports() if f.imported == "motion" and f.importer in ("devices", "kinematics")])
        == []
    )


def test_motion_knows_nothing_of_bytes() -> None:
    forbidden = ("fieldbus", "devices", "virtual", "struct")
    assert sentences([each for each in all_imports() if each.importer == "motion" and each.imported in forbidden]) == []


def test_kinematics_imports_only_the_standard_library_numpy_and_itself() -> None:
    allowed = {*sys.stdlib_module_names, "numpy", "kinematics"}
    imported = [each for each in all_imports() if each.importer == "kinematics"]
    assert sentences([each for each in imported if each.module.partition(".")[0] not in allowed]) == []


def declared(key: str) -> set[str]:
    # Python 3.10 has no reader of TOML; a list of strings is written there as in Python.
    listed = re.search(rf"^{key} = (\[.*?^\])", (ROOT / "pyproject.toml").read_text(), re.MULTILINE | re.DOTALL)
    assert listed
    return {re.split(r"[^\w.-]", name)[0].lower().replace("-", "_") for name in ast.literal_eval(listed[1])}


def test_what_is_imported_from_outside_is_a_declared_dependency() -> None:
    # typing_extensions is imported for the type checker alone.
    ours = {"rtcp", "kinematics", "typing_extensions", *sys.stdlib_module_names}
    optional = ABB | CLUSTER | GYM | ROS_2 | dict.fromkeys(ROS_FILES, ROS)
    imports = [each for each in all_imports() if each.module.partition(".")[0] not in optional.get(each.file, ())]
    outside = [(each.importer, each.module.partition(".")[0]) for each in imports]
    names = {(importer == "panel", PACKAGES.get(name, name)) for importer, name in outside if name not in ours}
    assert {name for of_panel, name in names if not of_panel} - declared("dependencies") == set()
    assert {name for of_panel, name in names if of_panel} - declared("dependencies") - declared("panel") == set()


def test_ros_is_a_client_of_the_api() -> None:
    """What it reads besides are files, configuration and geometry; of `motion` it has the quaternion of a rotation.

    The messages of Simple Message are the bus's, which speaks it to controllers.
    """
    imported = {each.module for each in all_imports() if each.importer == "ros" and is_ours(each)} - {"rtcp"}
    messages = "rtcp.fieldbus.simple_message"
    allowed = ("rtcp.ros", "rtcp.api", "rtcp.config", "kinematics", "rtcp.ipc.runtime_directory", messages)
    others = {module for module in imported if not module.startswith(allowed)}
    assert others == {"rtcp.motion.planning.interpolation"}


def test_the_panel_is_a_client_of_the_api() -> None:
    """What it reads besides are files: configuration and geometry."""
    imported = {each.imported for each in all_imports() if each.importer == "panel" and is_ours(each)}
    assert imported == {"panel", "api", "config", "kinematics"}


def test_modules_are_imported_by_a_name_made_at_run_time_in_two_places_only() -> None:
    # What this file cannot see: rtcp.config's own modules, on first use, so that the loop has no validator; and the
    # message packages of ROS 2, by the names of the types.
    by_name = {"import_module", "__import__"}
    callers = set()
    for path in sorted(ROOT.glob("rtcp/**/*.py")):
        text = path.read_text()
        if not any(name in text for name in by_name):
            continue
        nodes = list(ast.walk(ast.parse(text)))
        names = {node.id for node in nodes if isinstance(node, ast.Name)}
        attributes = {node.attr for node in nodes if isinstance(node, ast.Attribute)}
        if by_name & (names | attributes):
            callers.add(str(path.relative_to(ROOT)))
    assert callers == {"rtcp/config/__init__.py", "rtcp/ros/ros2_rclpy.py"}


# -- the reader of sources itself -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("file", "line", "breaches"),
    [
        ("rtcp/motion/bad.py", "import rtcp.devices.cia402", []),
        ("rtcp/motion/bad.py", "import rtcp.control.arm", ["rtcp.control.arm"]),
        ("rtcp/motion/bad.py", "def f():\n    from rtcp.cli.app import app", ["rtcp.cli.app"]),
        ("rtcp/motion/bad.py", "from rtcp import control", ["rtcp.control"]),
        ("rtcp/motion/bad.py", "from rtcp import __version__", []),
        ("rtcp/motion/bad.py", "from ..control import arm", ["rtcp.control"]),
        ("rtcp/motion/__init__.py", "from .guard import Guard", []),
        ("rtcp/panel/bad.py", "import rtcp.ros.node", ["rtcp.ros.node"]),
        ("rtcp/motion/bad.py", "import rtcp.unheard_of", ["rtcp.unheard_of"]),
        ("kinematics/bad.py", "import rtcp.config.model", ["rtcp.config.model"]),
    ],
)
def test_a_breach_is_seen_however_it_is_written(tmp_path: Path, file: str, line: str, breaches: list[str]) -> None:
    (tmp_path / file).parent.mkdir(parents=True)
    (tmp_path / file).write_text(line + "\n")
    seen = [each.module for each in imports_of(tmp_path) if is_ours(each) and breaks_the_order(each)]
    assert seen == breaches


# -- what the loop's process really loads ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def loaded() -> set[str]:
    """Names of the modules that a fresh interpreter has loaded for the loop's process, less those of its own start."""
    program = (
        "import json, sys; before = set(sys.modules)\n"
        "import rtcp.control.process, rtcp.fieldbus.soem\n"
        "print(json.dumps(sorted(set(sys.modules) - before)))"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    return set(json.loads(done.stdout))


def test_the_loops_process_loads_its_three_packages_and_the_standard_library(loaded: set[str]) -> None:
    names = {module.partition(".")[0] for module in loaded} - sys.stdlib_module_names - {"rtcp", "kinematics"}
    # Cython's own, which pysoem's extension module brings along: `cython_runtime`, `_cython_3_2_4`; and mypyc's.
    names = {name for name in names if not name.lstrip("_").startswith("cython") and not name.endswith("__mypyc")}
    assert names - LET_IN_BY_OTHERS == IN_THE_LOOP


def test_the_loops_process_loads_no_validator_no_commands_and_no_network_tools(loaded: set[str]) -> None:
    assert {module.partition(".")[0] for module in loaded} & NEVER_IN_THE_LOOP == set()


def test_the_loops_process_loads_nothing_of_the_virtual_segment_and_the_commands(loaded: set[str]) -> None:
    assert [name for name in loaded if place_of(name) in ("virtual", "telemetry", "panel", "ros", "cli")] == []


def test_the_loops_process_loads_no_server_and_no_event_loop(loaded: set[str]) -> None:
    assert loaded & {"asyncio", "http", "http.server", "socketserver"} == set()
