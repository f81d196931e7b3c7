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


def procedure(module: str, name: str) -> str:
    """Return the text of a procedure, function or trap of a module."""
    text = (RAPID / module).read_text(encoding="utf-8")
    return re.split(r"END(?:PROC|FUNC|TRAP)", text[re.search(rf"(?:PROC|FUNC \w+|TRAP) {name}\b", text).start() :])[0]


def test_no_wait_for_a_client_is_without_a_time_limit() -> None:
    shared = (RAPID / "stream_shared.sys").read_text(encoding="utf-8")
    for path in STREAMING:
        for line in path.read_text(encoding="utf-8").splitlines():
            assert not re.search(r"Socket(Receive|Accept) (?!.*\\Time)", line), line
    assert "\\Time:=time_limit" in procedure("stream_shared.sys", "receive_bytes")
    limits = {name: float(re.search(rf"{name} := ([\d.]+);", shared)[1]) for name in ("CLIENT_TIMEOUT", "IDLE_TIMEOUT")}
    assert 0.0 < limits["CLIENT_TIMEOUT"] < limits["IDLE_TIMEOUT"]
    assert "silence_limit := CLIENT_TIMEOUT;" in procedure("stream_server.mod", "serve_message")
    assert "reason = ERR_SOCK_TIMEOUT" in procedure("stream_server.mod", "main")
    assert "IF ClkRead(silence) > CLIENT_TIMEOUT ExitCycle;" in procedure("stream_state.mod", "main")


def test_a_port_that_an_earlier_program_left_open_is_tried_again_until_it_is_free() -> None:
    bind = procedure("stream_shared.sys", "bind_port")
    steps = (
        "ERRNO = ERR_SOCK_ADDR_INUSE",
        "WaitTime PORT_RETRY;",
        "SocketCreate server;",
        "ResetRetryCount;",
        " RETRY;",
    )
    assert sorted(bind.index(step) for step in steps) == [bind.index(step) for step in steps]


def test_the_motors_go_off_when_no_client_has_come_and_on_only_in_automatic_mode() -> None:
    main = procedure("stream_server.mod", "main")
    assert "accept_client server, client, MOTION_PORT, MOTORS_OFF_TIME;" in main
    assert re.search(r"AND NOT connected PulseDO .*doOrderMotorsOff;", main)
    order = procedure("stream_server.mod", "order_motors")
    assert re.search(r"OpMode\(\) = OP_AUTO AND .*doEmergencyStop\) = 0 THEN\s+PulseDO .*doOrderMotorsOn;", order)


def test_the_arms_move_while_the_signal_of_any_unit_says_so() -> None:
    moving = procedure("stream_state.mod", "moving")
    for unit in range(1, 5):
        guard = "" if unit == 1 else rf"UNITS > {unit - 1} AND "
        assert re.search(rf"IF {guard}DOutput\(doNotMoving{unit}\) = 0 RETURN 1;", moving)


def test_a_start_that_the_controller_refuses_stops_no_task() -> None:
    assert "IF ERRNO = ERR_STARTMOVE TRYNEXT;" in procedure("stream_motion.mod", "forget_queue")
    stop = procedure("stream_server.mod", "stop_motion")
    assert "IF ERRNO = ERR_STARTMOVE RETURN;" in stop
    assert stop.index("StartMove") < stop.index("stop_confirmed := TRUE;")  # skipped then: the next point stops anew


def test_coordinated_moves_are_called_by_names_that_the_optional_module_has() -> None:
    motion, optional = (
        (RAPID / name).read_text(encoding="utf-8") for name in ("stream_motion.mod", "stream_coordinated.mod")
    )
    called = set(re.findall(r'%"(\w+)"%', motion))
    assert called == names(optional, "PROC") | set(re.findall(r"PROC (\w+)\(", optional))
    assert "SyncMove" not in motion
    assert procedure("stream_coordinated.mod", "coordinate").index("SyncMoveUndo;") < optional.index("SyncMoveOn ")


def test_every_signal_of_the_modules_is_in_the_table_of_parameters() -> None:
    table = (RAPID.parent / "config" / "parameters.md").read_text(encoding="utf-8")
    text = "".join(re.sub(r"!.*", "", path.read_text(encoding="utf-8")) for path in STREAMING)
    signals = set(re.findall(r"\b(?:do|di|go|gi)[A-Z]\w+", text))
    listed = set(re.findall(r"`((?:do|di|go|gi)[A-Z]\w+)`", table))
    assert signals - listed == {"doNotMoving2", "doNotMoving3"}  # between the first and the last, which are listed
