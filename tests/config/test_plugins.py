from __future__ import annotations

from importlib.metadata import EntryPoint, EntryPoints

import pytest

from rtcp.config import find
from rtcp.config.find import load_class, registered
from rtcp.config.model import PluginError
from rtcp.devices.driver import Driver
from rtcp.virtual.faults import frames, shape_setter, slaves
from rtcp.virtual.faults.fault import Fault
from rtcp.virtual.faults.registry import installed

GROUP = "rtcp.devices"


@pytest.mark.parametrize(
    ("value", "problem"),
    [
        ("no_such_module:Driver", "cannot be loaded: ModuleNotFoundError: No module named 'no_such_module'"),
        ("rtcp.devices.driver:NoSuch", "cannot be loaded: AttributeError"),
        ("tests.config.raises:Driver", "cannot be loaded"),
        ("pathlib:Path", "is not a subclass of rtcp.devices.driver.Driver"),
        ("math:pi", "is not a subclass of rtcp.devices.driver.Driver"),
    ],
)
def test_an_entry_point_that_cannot_serve_is_named_with_the_reason(value: str, problem: str) -> None:
    with pytest.raises(PluginError) as raised:
        load_class(EntryPoint("scale", value, GROUP), Driver)
    assert str(raised.value).startswith(f"entry point scale = {value} of {GROUP} {problem}")


def test_two_packages_with_the_same_name_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    points = EntryPoints([EntryPoint("scale", value, GROUP) for value in ("one:Scale", "two:Scale")])
    monkeypatch.setattr(find, "installed", lambda group: points.select(group=group))
    with pytest.raises(PluginError, match="has the name of one:Scale"):
        registered(GROUP)


def test_a_package_that_is_found_twice_counts_once(monkeypatch: pytest.MonkeyPatch) -> None:
    points = EntryPoints([EntryPoint("scale", "one:Scale", GROUP)] * 2)
    monkeypatch.setattr(find, "installed", lambda group: points.select(group=group))
    assert list(registered(GROUP)) == ["scale"]


def test_every_fault_of_this_package_is_registered() -> None:
    modules = (slaves, frames, shape_setter)
    kinds = [kind for module in modules for kind in vars(module).values() if isinstance(kind, type)]
    named = {kind for kind in kinds if issubclass(kind, Fault) and "name" in vars(kind)}
    assert named == set(installed().values())
