"""Which file is read: the one given, else the environment's, else the machine's, else the default."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtcp.config import ConfigError, default_config, find, find_arm, find_config


@pytest.fixture
def system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The machine's file, in a place that a test may write."""
    monkeypatch.delenv(find.ENVIRONMENT, raising=False)
    monkeypatch.setattr(find, "SYSTEM", tmp_path / "etc" / "assistive_arm.yaml")
    return tmp_path / "etc" / "assistive_arm.yaml"


def made(path: Path) -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_text("name: arm\n")
    return path


def test_the_file_given_comes_before_all_others(system: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made(system)
    monkeypatch.setenv("RTCP_CONFIG", str(made(tmp_path / "environment.yaml")))
    given = made(tmp_path / "given.yaml")
    assert find_config(given) == given


def test_the_environment_comes_before_the_machine(
    system: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made(system)
    named = made(tmp_path / "environment.yaml")
    monkeypatch.setenv("RTCP_CONFIG", str(named))
    assert find_config() == named


def test_the_machine_comes_before_the_default(system: Path) -> None:
    assert find_config() == default_config()
    made(system)
    assert find_config() == system


@pytest.mark.usefixtures("system")
def test_an_empty_environment_variable_names_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RTCP_CONFIG", "")
    assert find_config() == default_config()


def test_a_given_file_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    missing = tmp_path / "missing.yaml"
    with pytest.raises(ConfigError) as caught:
        find_config(missing)
    assert caught.value.problems == [f"{missing}, named by --config, does not exist; name the arm's file"]


def test_a_file_of_the_environment_that_does_not_exist_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RTCP_CONFIG", str(tmp_path))
    with pytest.raises(ConfigError) as caught:
        find_config()
    assert caught.value.problems == [f"{tmp_path}, named by RTCP_CONFIG, is a directory; name the arm's file in it"]


# -- which arm ---------------------------------------------------------------------------------------------------------


def test_without_a_name_the_arm_is_that_of_the_platform(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("RTCP_CONFIG", str(default_config()))
    assert find_arm() == default_config()


@pytest.mark.parametrize("name", ["abb_irb120", "assistive_arm"])
def test_a_bare_name_is_a_file_beside_the_default(name: str) -> None:
    assert find_arm(name) == default_config().parent / f"{name}.yaml"


def test_a_path_is_a_path_also_without_an_ending(directory: Path) -> None:
    Path("mine").write_bytes(Path("abb_irb120.yaml").read_bytes())
    assert find_arm("mine") == Path("mine")
    assert find_arm("./abb_irb120.yaml") == Path("abb_irb120.yaml")


@pytest.mark.parametrize("given", ["none.yaml", "./none", "none/arm", "/none"])
def test_a_path_that_leads_nowhere_is_named(directory: Path, given: str) -> None:
    with pytest.raises(ConfigError, match="named by --arm, does not exist"):
        find_arm(given)


def test_an_unknown_name_is_answered_with_the_known_ones(directory: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        find_arm("abb_irb140")
    wanted = "there is no such file, and no arm of this name; known are abb_irb120, abb_irb120_rapid, assistive_arm"
    assert caught.value.problems == [f"--arm abb_irb140: {wanted}"]
