"""The file of zero offsets: written whole or not at all, and every damage named."""

from __future__ import annotations

import os
import signal
import stat
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtcp.config import ConfigError, default_config, load
from rtcp.config.zero import read_zeros, state_directory, store_zero, zero_file
from rtcp.launch.launcher import StartOptions, _configure
from tests.findings import assert_finds, findings_of
from tests.samples import examples

ARM = load(default_config())


@pytest.fixture(autouse=True)
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("RTCP_STATE_DIR", str(tmp_path / "state"))
    return tmp_path / "state"


def spoil(old: str, new: str) -> None:
    file = zero_file(ARM.name)
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))


# -- where it is -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("environment", "user", "directory"),
    [
        ({"RTCP_STATE_DIR": "/x"}, 0, "/x"),
        ({"XDG_STATE_HOME": "/y"}, 0, "/var/lib/rtcp"),
        ({"XDG_STATE_HOME": "/y"}, 1000, "/y/rtcp"),
        ({"RTCP_STATE_DIR": ""}, 1000, "/home/me/.local/state/rtcp"),
        ({"XDG_STATE_HOME": "relative"}, 1000, "/home/me/.local/state/rtcp"),
    ],
)
def test_the_state_directory_is_the_first_of_these(
    monkeypatch: pytest.MonkeyPatch, environment: dict[str, str], user: int, directory: str
) -> None:
    for key in ("RTCP_STATE_DIR", "XDG_STATE_HOME"):
        monkeypatch.delenv(key, raising=False)
    for key, value in {"HOME": "/home/me", **environment}.items():
        monkeypatch.setenv(key, value)
    monkeypatch.setattr(os, "geteuid", lambda: user)
    assert state_directory() == Path(directory)


def test_no_name_of_an_arm_leaves_the_directory(state: Path) -> None:
    names = ("../x", "a/b", "a%2Fb", "..", ".", "a b", "arm\n", "a\0b", "Arm-Süd_1.2")
    files = {zero_file(name) for name in names}
    assert {file.parent for file in files} == {state}
    assert len(files) == len(names)
    assert zero_file("Arm-Süd_1.2").name == "Arm-Süd_1.2.zero.yaml"


# -- what it holds -----------------------------------------------------------------------------------------------------


def test_without_a_file_there_are_no_offsets() -> None:
    assert read_zeros(ARM) == ()


@settings(max_examples=examples(100))
@given(
    st.lists(st.floats(-99, 99), min_size=6, max_size=6), st.text(st.characters(codec="utf-8"), min_size=1, max_size=9)
)
def test_what_is_stored_is_read_back_to_the_last_bit(offsets: list[float], name: str) -> None:
    joints = (
        replace(ARM.joints[0], name=name),
        *(replace(joint, name=f"{joint.name} of {name}") for joint in ARM.joints[1:]),
    )
    config = replace(ARM, name=f"an arm {name}", joints=joints)
    for axis, offset in enumerate(offsets):
        store_zero(config, axis, offset)
    assert read_zeros(config) == tuple(offsets)


def test_offsets_go_by_the_names_of_the_axes() -> None:
    store_zero(ARM, 0, 0.5)
    turned = replace(ARM, joints=ARM.joints[::-1])
    assert read_zeros(turned) == (0.0, 0.0, 0.0, 0.0, 0.0, 0.5)


def test_the_start_puts_the_offsets_into_the_configuration() -> None:
    options = StartOptions(config=default_config())
    assert _configure(options).zero_offsets == ()
    store_zero(ARM, 1, 0.75)
    assert _configure(options).zero_offsets == (0.0, 0.75, 0.0, 0.0, 0.0, 0.0)
    spoil("0.75", "0.76")
    assert_finds(lambda: _configure(options), "check: checksum")


# -- what is wrong with it ---------------------------------------------------------------------------------------------

DAMAGE = {
    "a changed digit": (("0.125", "0.126"), ["3 check: checksum"]),
    "another arm's": (('"assistive-arm"', '"other"'), ["2 arm: other_arm found=other"]),
    "a text": (("0.125", "zero"), ["7 offsets.joint3: range"]),
    "nothing": (("0.125", ""), ["7 offsets.joint3: range"]),
    "a truth": (("0.125", "true"), ["7 offsets.joint3: range"]),
    "no number": (("0.125", ".nan"), ["7 offsets.joint3: range"]),
    "degrees": (("0.125", "180"), ["7 offsets.joint3: range found=180"]),
    "an unknown joint": (('"joint3"', '"joint9"'), ["4 offsets: missing key=joint3", "7 offsets.joint9: no_axis"]),
    "an unknown key": (("check:", "checks:"), ["2 : missing key=check", "3 checks: unknown"]),
    "a joint twice": (('"joint3"', '"joint2"'), ["6 offsets.joint2: key_twice first=6 at=7"]),
    "no YAML": (("offsets:", "offsets: ["), [": not_yaml"]),
}


@pytest.mark.parametrize(("change", "expected"), DAMAGE.values(), ids=DAMAGE.keys())
def test_damage_is_named_and_nothing_of_the_file_is_used(change: tuple[str, str], expected: list[str]) -> None:
    store_zero(ARM, 2, 0.125)
    spoil(*change)
    assert_finds(lambda: read_zeros(ARM), *expected)


def named_or(offsets: tuple[float, ...]) -> bool:
    """Whether the file is refused with a message or has these offsets."""
    try:
        return read_zeros(ARM) == offsets
    except ConfigError as error:
        return bool(error.problems)


def test_a_file_that_was_cut_anywhere_is_refused() -> None:
    store_zero(ARM, 5, 0.125)
    file = zero_file(ARM.name)
    whole = file.read_bytes()
    # Without its last character, the end of a line, it is still complete.
    for length in range(len(whole) - 1):
        file.write_bytes(whole[:length])
        assert findings_of(lambda: read_zeros(ARM))


def test_a_byte_that_was_changed_anywhere_is_found_or_changes_nothing() -> None:
    store_zero(ARM, 2, 0.125)
    file = zero_file(ARM.name)
    whole, offsets = file.read_bytes(), read_zeros(ARM)
    for place in range(len(whole)):
        for bit in (1, 16):
            file.write_bytes(bytes(byte ^ bit if i == place else byte for i, byte in enumerate(whole)))
            assert named_or(offsets)


def test_a_link_that_leads_nowhere_is_no_missing_file(state: Path) -> None:
    state.mkdir()
    zero_file(ARM.name).symlink_to(state / "nowhere")
    assert_finds(lambda: read_zeros(ARM), ": no_file")


def test_an_offset_beyond_the_wire_is_refused() -> None:
    drive = ARM.slaves[1].device
    channels = tuple(
        replace(channel, type="int16", factor=0.001) if channel.name == "target_position" else channel
        for channel in drive.rpdo[0].channels
    )
    short = replace(drive, rpdo=(replace(drive.rpdo[0], channels=channels),))
    arm = replace(
        ARM, slaves=tuple(replace(slave, device=short) if slave.device == drive else slave for slave in ARM.slaves)
    )
    store_zero(arm, 0, 29.6)
    for offset in (29.7, -29.7):
        expected = f"offsets.joint1: offset_beyond_wire found={offset} low=-32.768 high=32.767"
        assert_finds(partial(store_zero, arm, 0, offset), expected)
    assert read_zeros(arm)[0] == 29.6


@pytest.mark.parametrize("offset", [float("nan"), float("inf"), 101.0, -101.0])
def test_an_offset_that_is_none_is_refused_and_the_file_stays(offset: float) -> None:
    store_zero(ARM, 0, 0.5)
    assert_finds(lambda: store_zero(ARM, 0, offset), "offsets.joint1: range")
    assert read_zeros(ARM)[0] == 0.5


def test_a_damaged_file_is_not_written_over() -> None:
    store_zero(ARM, 0, 0.5)
    spoil("0.5", "0.6")
    before = zero_file(ARM.name).read_bytes()
    assert_finds(lambda: store_zero(ARM, 1, 0.5), "check: checksum")
    assert zero_file(ARM.name).read_bytes() == before


def test_a_directory_that_cannot_be_made_is_named(state: Path) -> None:
    state.write_text("a file")
    with pytest.raises(ConfigError, match=r"state: the directory cannot be used: "):
        store_zero(ARM, 0, 0.5)


def test_a_disk_that_is_full_is_named_and_the_old_file_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    store_zero(ARM, 0, 0.5)

    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", full)
        with pytest.raises(ConfigError, match="cannot be written: No space left on device"):
            store_zero(ARM, 0, 0.6)
    assert read_zeros(ARM)[0] == 0.5
    store_zero(ARM, 0, 0.7)
    assert read_zeros(ARM)[0] == 0.7


def test_the_file_is_readable_for_all_and_writable_for_its_owner() -> None:
    before = os.umask(0o022)
    try:
        assert stat.S_IMODE(store_zero(ARM, 0, 0.5).stat().st_mode) == 0o644
    finally:
        os.umask(before)


# -- interrupted between any two steps ---------------------------------------------------------------------------------


def store_and_kill(at: int) -> int:
    """Store an offset in a process that kills itself after its n-th call to the disk; return how that ended.

    A write is done by halves. Nothing kills the process where n is 0: it returns the number of calls.
    """
    if pid := os.fork():
        return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    count = 0

    def counted(name: str) -> Callable[..., Any]:
        real = getattr(os, name)

        def call(*given: Any, **more: Any) -> Any:
            nonlocal count
            count += 1
            here = count
            if name == "write":
                given = (given[0], given[1][: (len(given[1]) + 1) // 2])
            result = real(*given, **more)
            if here == at:
                os.kill(os.getpid(), signal.SIGKILL)
            return result

        return call

    for name in ("open", "write", "fsync", "replace", "close"):
        setattr(os, name, counted(name))
    try:
        store_zero(ARM, 0, 0.9)
    finally:
        os._exit(count)


def test_killed_between_any_two_steps_it_leaves_the_old_file_or_the_new_one() -> None:
    store_zero(ARM, 0, 0.1)
    store_zero(ARM, 1, 0.2)
    old = zero_file(ARM.name).read_bytes()
    steps = store_and_kill(0)
    new = zero_file(ARM.name).read_bytes()
    assert steps > 8
    seen = []
    for at in range(1, steps + 1):
        zero_file(ARM.name).write_bytes(old)
        assert store_and_kill(at) == -signal.SIGKILL
        seen.append(read_zeros(ARM)[0])
        assert zero_file(ARM.name).read_bytes() in (old, new)
        # A temporary file that was left does no harm.
        store_zero(ARM, 1, 0.2)
        assert read_zeros(ARM)[1] == 0.2
    assert seen == sorted(seen)
    assert {*seen} == {0.1, 0.9}


def test_a_remnant_of_an_interrupted_write_does_not_show_in_the_next(state: Path) -> None:
    state.mkdir()
    (state / f".{zero_file(ARM.name).name}.new").write_text("x: 1\n" * 1000)
    store_zero(ARM, 0, 0.1)
    assert read_zeros(ARM)[0] == 0.1


def test_the_new_file_is_on_the_disk_before_it_takes_the_olds_name_and_the_name_after(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    store_zero(ARM, 0, 0.1)
    calls: list[str] = []
    fsync, rename = os.fsync, os.replace

    def synced(descriptor: int) -> None:
        kind = "directory" if stat.S_ISDIR(os.fstat(descriptor).st_mode) else "file"
        calls.append(f"fsync {kind} of {os.fstat(descriptor).st_size if kind == 'file' else ''}")
        fsync(descriptor)

    def renamed(old: Path, new: Path) -> None:
        calls.append("rename")
        rename(old, new)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", renamed)
    size = store_zero(ARM, 0, 0.2).stat().st_size
    assert calls == [f"fsync file of {size}", "rename", "fsync directory of "]


def test_two_writers_wait_for_each_other(state: Path) -> None:
    store_zero(ARM, 0, 0.0)
    code = (
        "import sys; from rtcp.config import default_config, load; from rtcp.config.zero import store_zero\n"
        "config, axis = load(default_config()), int(sys.argv[1])\n"
        "for i in range(20): store_zero(config, axis, i / 64)\n"
    )
    writers = [subprocess.Popen([sys.executable, "-c", code, str(axis)]) for axis in range(2)]
    assert [writer.wait() for writer in writers] == [0, 0]
    assert read_zeros(ARM) == (19 / 64, 19 / 64, 0.0, 0.0, 0.0, 0.0)


def test_an_axis_without_ends_has_a_zero_beside_one_with_ends() -> None:
    config = load(default_config().parent / "linear_axis.yaml")
    store_zero(config, 0, 0.1)
    store_zero(config, 1, -0.25)
    assert read_zeros(config) == (0.1, -0.25)
