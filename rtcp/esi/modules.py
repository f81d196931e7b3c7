"""Modules put into the slots of a device."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import TypeVar

from rtcp.esi.model import Device, DictionaryObject, EsiError, InitCommand, Module, Pdo, Slot

_Item = TypeVar("_Item", DictionaryObject, InitCommand)
IDENT_LIST = 0xF030
"""Configured module ident list (ETG.5001.1)."""


def places(device: Device) -> tuple[Slot, ...]:
    """Return the slot of each place, by number: a slot that holds n modules has n places."""
    return tuple(slot for slot in device.slots for _ in range(slot.maximum))


def allowed(slot: Slot, modules: Iterable[Module]) -> tuple[Module, ...]:
    """Return the modules allowed in a slot."""
    return tuple(
        module
        for module in modules
        if module.ident in slot.idents or (module.module_class and module.module_class in slot.classes)
    )


def defaults(device: Device) -> dict[int, int]:
    """Return the default idents by place number."""
    chosen: dict[int, int] = {}
    number = 0
    for slot in device.slots:
        if slot.default is not None:
            chosen.update(dict.fromkeys(range(number, number + min(max(slot.minimum, 1), slot.maximum)), slot.default))
        number += slot.maximum
    return chosen


def assemble(device: Device, modules: Iterable[Module], chosen: Mapping[int, int | None] | None = None) -> Device:
    """Return a device with modules in its slots.

    `chosen`: ident of the module by place, from 0; None: the place is empty; a place without entry holds the default of
    its slot. `modules`: those of the device's file, and of other files where a slot names a class. The indices of PDOs,
    objects and start-up commands grow by the increments of the slot. Raises EsiError, with the allowed modules.
    """
    available = tuple(modules)
    slots = places(device)
    filled: dict[int, int | None] = {**defaults(device), **(chosen or {})}
    unknown = [number for number in filled if not 0 <= number < len(slots)]
    if unknown:
        raise EsiError(device.origin, f"{device.name} has no place {unknown[0]}; it has {len(slots)}, from 0")
    rx_pdos, tx_pdos = list(device.rx_pdos), list(device.tx_pdos)
    objects = {item.index: item for item in device.objects}
    commands = list(device.init_commands)
    present: dict[int, int] = {}
    for number in sorted(filled):
        ident, slot = filled[number], slots[number]
        if ident is None:
            continue
        module = _module(device, number, slot, ident, available)
        present[number] = ident
        shift = number * slot.index_increment
        pdo_shift = number * slot.pdo_increment
        place = f"{module.name} at place {number} of {device.name}"
        for pdos, added in ((rx_pdos, module.rx_pdos), (tx_pdos, module.tx_pdos)):
            for pdo in added:
                _add_pdo(pdos, _shifted_pdo(pdo, pdo_shift, shift, place), place)
        for item in module.objects:
            moved = _moved(item, shift, pdo_shift, place)
            objects[moved.index] = moved
        commands += [_moved(command, shift, pdo_shift, place) for command in module.init_commands]
    if device.download_module_idents and present:
        commands += _ident_commands(present)
    return replace(
        device,
        rx_pdos=tuple(rx_pdos),
        tx_pdos=tuple(tx_pdos),
        objects=tuple(objects[index] for index in sorted(objects)),
        init_commands=tuple(commands),
        modules=tuple(sorted(present.items())),
    )


def _module(device: Device, number: int, slot: Slot, ident: int, available: tuple[Module, ...]) -> Module:
    fitting = allowed(slot, available)
    for module in fitting:
        if module.ident == ident:
            return module
    offered = (
        ", ".join(f"0x{module.ident:X} {module.name}" for module in fitting[:20]) or "none of those that are known"
    )
    more = f", and {len(fitting) - 20} more" if len(fitting) > 20 else ""
    raise EsiError(
        device.origin,
        f"no module 0x{ident:X} for place {number} ({slot.name}) of {device.name}; allowed: {offered}{more}",
    )


def _add_pdo(pdos: list[Pdo], pdo: Pdo, place: str) -> None:
    for position, present in enumerate(pdos):
        if present.index == pdo.index:
            if not present.overwritten_by_module:
                raise EsiError(place, f"the PDO 0x{pdo.index:04X} ({pdo.name}) is there already ({present.name})")
            pdos[position] = pdo
            return
    pdos.append(pdo)


def _index(index: int, shift: int, place: str) -> int:
    if index + shift > 0xFFFF:
        raise EsiError(place, f"the index 0x{index:04X} would grow to 0x{index + shift:X}")
    return index + shift


def _shifted_pdo(pdo: Pdo, pdo_shift: int, shift: int, place: str) -> Pdo:
    entries = tuple(
        replace(entry, index=_index(entry.index, shift, place)) if entry.index and entry.depends_on_slot else entry
        for entry in pdo.entries
    )
    if not pdo.depends_on_slot:
        return replace(pdo, entries=entries)
    return replace(
        pdo,
        index=_index(pdo.index, pdo_shift, place),
        entries=entries,
        excludes=frozenset(_index(index, pdo_shift, place) for index in pdo.excludes),
    )


def _moved(item: _Item, shift: int, pdo_shift: int, place: str) -> _Item:
    """Return an object or a command for a place; mapping objects grow as their PDOs do."""
    if not item.depends_on_slot:
        return item
    return replace(item, index=_index(item.index, pdo_shift if 0x1600 <= item.index < 0x1C00 else shift, place))


def _ident_commands(present: Mapping[int, int]) -> list[InitCommand]:
    """Return the commands that write the idents of the modules to their list."""
    count = max(present) + 1
    commands = [InitCommand(("PS",), IDENT_LIST, 0, b"\0", comment="clear the list of modules")]
    commands += [
        InitCommand(
            ("PS",), IDENT_LIST, number + 1, present.get(number, 0).to_bytes(4, "little"), comment="module ident"
        )
        for number in range(min(count, 254))
    ]
    commands.append(InitCommand(("PS",), IDENT_LIST, 0, bytes([min(count, 254)]), comment="number of modules"))
    return commands
