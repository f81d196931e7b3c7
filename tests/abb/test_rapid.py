"""The RAPID modules for the controller, checked for syntax by rapidchecker.

It refuses some legal RAPID: `ERROR (list)`, expressions as array index. The modules do without.
"""

from __future__ import annotations

import re
import struct
from math import nan
from pathlib import Path
from types import SimpleNamespace

import pytest

rapid = pytest.importorskip("rapidchecker.cli", reason="rapidchecker is not installed: pip install 'rtcp[dev]'")

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # rapidchecker and the newest pyparsing

RAPID = Path(__file__).parents[2] / "abb" / "rapid"
MODULES = sorted(RAPID.iterdir())
STREAMING = [path for path in MODULES if path.name.startswith("stream")]
SEEDED = {
    "a missing semicolon": (r"TPWrite (.*);", r"TPWrite \1"),
    "an IF without its end": (r"\n *ENDIF", ""),
    "an assignment written as a comparison": (r"(\w+) := FALSE;", r"\1 = FALSE;"),
    "a loop without its end": (r"\n *ENDWHILE", ""),
}


def errors(text: str) -> list[str]:
    return [str(error) for error in rapid.check_file(text)]


def names(text: str, kind: str) -> set[str]:
    return set(re.findall(rf"^  (?:LOCAL )?{kind} \w+ (\w+)", text, re.MULTILINE))


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.name)
def test_a_module_is_correct_rapid(path: Path) -> None:
    assert errors(path.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("seeded", SEEDED)
def test_a_seeded_error_is_found(seeded: str) -> None:
    text = (RAPID / "egm.mod").read_text(encoding="utf-8")
    pattern, replacement = SEEDED[seeded]
    broken, count = re.subn(pattern, replacement, text, count=1)
    assert count == 1
    assert errors(broken) != []


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.name)
def test_names_and_lines_fit_the_controller(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert text.isascii()
    assert re.findall(r"\b\w{33,}", text) == []  # RobotWare: identifiers have at most 32 characters


@pytest.mark.parametrize("path", STREAMING, ids=lambda path: path.name)
def test_every_procedure_that_is_called_exists(path: Path) -> None:
    shared = (RAPID / "stream_shared.sys").read_text(encoding="utf-8")
    text = path.read_text(encoding="utf-8")
    defined = {name for source in (text, shared) for name in re.findall(r"(?:MODULE|PROC|FUNC \w+|TRAP) (\w+)", source)}
    code = re.sub(r'".*?"|!.*', "", text)
    statements = set(re.findall(r"^ +([a-z]+_\w+)(?= [^:]|;)", code, re.MULTILINE))
    functions = set(re.findall(r"\b([a-z]+_\w+)\(", code))
    assert (statements | functions) - defined == set()


def test_no_name_of_the_shared_module_is_declared_again() -> None:
    shared = (RAPID / "stream_shared.sys").read_text(encoding="utf-8")
    kinds = ("CONST", "PERS", "VAR", "PROC", "FUNC")
    shared_names = {name.lower() for kind in kinds for name in names(shared, kind)}
    for path in STREAMING:
        if path.suffix == ".mod":
            own = {name.lower() for kind in kinds for name in names(path.read_text(encoding="utf-8"), kind)}
            assert own & shared_names == set(), path.name


@pytest.mark.parametrize(("joints", "length"), [(10, 64), (12, 72)])
def test_the_server_reads_the_duration_where_the_message_has_it(joints: int, length: int) -> None:
    text = (RAPID / "stream_server.mod").read_text(encoding="utf-8")
    message = struct.pack(f"<4i{joints + 2}f", 11, 2, 0, 7, *[0.5] * joints, 1.0, 0.25)  # without the length before it
    assert len(message) == length
    deadline = re.search(r"at := length - (\d+);\n +UnpackRawBytes message, at, duration", text)
    assert deadline is not None
    assert struct.unpack_from("<f", message, length - int(deadline[1]) - 1) == (0.25,)  # RAPID counts bytes from 1


def test_no_arm_moves_after_a_stop_before_every_motion_task_has_forgotten_its_queue() -> None:
    server = (RAPID / "stream_server.mod").read_text(encoding="utf-8")
    stop = server[server.index("PROC stop_motion()") :].split("ENDPROC")[0]
    steps = (
        "stop_confirmed := FALSE;",
        r"StopMove \AllMotionTasks;",
        "stop_number :=",
        "WaitUntil all_have_stopped()",
        r"StartMove \AllMotionTasks;",
        "stop_confirmed := TRUE;",
        "ERROR",
    )
    assert sorted(stop.index(step) for step in steps) == [stop.index(step) for step in steps]
    assert server.count("StartMove") == 1
    point = server[server.index("PROC take_point(") :].split("ENDPROC")[0]
    assert point.index("IF NOT stop_confirmed RETURN;") < point.index("offer accepted;")


def test_the_server_stops_the_arms_whatever_error_ends_it() -> None:
    server = (RAPID / "stream_server.mod").read_text(encoding="utf-8")
    handler = server[server.index("PROC main()") :].split("ENDPROC")[0].split("  ERROR\n")[1]
    assert handler.index("stop_motion;") < handler.index("IF ")


def test_a_motion_task_that_was_started_anew_lets_the_server_stop_before_the_next_point() -> None:
    motion = (RAPID / "stream_motion.mod").read_text(encoding="utf-8")
    server = (RAPID / "stream_server.mod").read_text(encoding="utf-8")
    main = motion[motion.index("PROC main()") :].split("WHILE TRUE DO")[0]
    answer = r"IPers .*IF stopped THEN\s+stop_done\{unit\} := stop_number;\s+ELSE\s+stop_done\{unit\} := -1;"
    assert re.search(answer, main, re.DOTALL)
    assert re.search(r"ClearPath;.*stopped := TRUE;\s+ExitCycle;", motion, re.DOTALL)
    assert "OR NOT (stop_confirmed AND all_have_stopped()) stop_motion;" in server


@pytest.mark.parametrize("joint", range(6))
def test_a_point_is_near_only_if_every_joint_is_a_number_and_near(joint: int) -> None:
    shared = (RAPID / "stream_shared.sys").read_text(encoding="utf-8")
    body = shared[shared.index("FUNC bool is_near") :].split("ENDFUNC")[0]
    lines = [line.strip().rstrip(";") for line in body.splitlines()[2:] if line.strip()]
    code = (
        "\n".join(lines).replace("AND", "and").replace("Abs(", "abs(").replace(":=", "=").replace("RETURN", "result =")
    )

    def is_near(value: float, most: float) -> bool:
        axes = {f"rax_{i + 1}": 10.0 for i in range(6)}
        names = {"a": SimpleNamespace(**axes | {f"rax_{joint + 1}": value}), "b": SimpleNamespace(**axes), "most": most}
        exec(code, names)
        return bool(names["result"])

    assert (is_near(11.0, 1.0), is_near(9.0, 1.0)) == (True, True)
    assert (is_near(11.5, 1.0), is_near(8.5, 1.0), is_near(nan, 1.0), is_near(10.0, nan)) == (False,) * 4
