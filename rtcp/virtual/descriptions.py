"""Devices of a segment's file: models, and slaves described by ESI files and SII images."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

from rtcp.config.findings import Finding, KeyPath
from rtcp.config.segment import SegmentSlave
from rtcp.esi.model import Device, DeviceFile, EsiError
from rtcp.esi.modules import assemble
from rtcp.esi.reader import find_device, read_esi
from rtcp.esi.sii import MAX_BYTES, read_sii, write_sii
from rtcp.esi.xml_tree import read_file
from rtcp.virtual.behaviour import find_behaviour
from rtcp.virtual.described import DescribedDevice, with_alias
from rtcp.virtual.device import DeviceModel, OptionError, create


class Descriptions:
    """Makes the devices of a segment's file; reads each description once."""

    def __init__(self, folder: Path) -> None:
        """File and module names are relative to `folder`."""
        self._folder = folder
        self._files: dict[str, DeviceFile] = {}

    def make(self, slave: SegmentSlave) -> DeviceModel:
        """Return the device of a slave.

        Raises:
            OptionError: with the key of the mistake.
        """
        if slave.model is not None:
            return create(slave.model, **slave.options)
        device, image = self._of_esi(slave, slave.esi) if slave.esi is not None else self._of_sii(slave)
        behaviour = None
        if slave.behaviour is not None:
            if str(self._folder) not in sys.path:
                sys.path.append(str(self._folder))
            behaviour = find_behaviour(slave.behaviour)
        return DescribedDevice(device, image, behaviour, **slave.options)

    def _of_esi(self, slave: SegmentSlave, name: str) -> tuple[Device, Callable[[int], bytes]]:
        try:
            if name not in self._files:
                self._files[name] = read_esi(self._folder / name)
            file = self._files[name]
        except EsiError as error:
            raise _mistake("esi", error) from error
        try:
            device = find_device(file, product=slave.product, revision=slave.revision, choice=slave.choice)
        except EsiError as error:
            raise _mistake("esi" if slave.product is None else "product", error) from error
        try:
            device = assemble(device, file.modules, dict(enumerate(slave.modules)))
        except EsiError as error:
            raise _mistake("modules", error) from error
        image = partial(write_sii, device)
        try:
            image(slave.alias)
        except EsiError as error:
            raise _mistake("esi", error) from error
        return device, image

    def _of_sii(self, slave: SegmentSlave) -> tuple[Device, Callable[[int], bytes]]:
        assert slave.sii is not None
        path = self._folder / slave.sii
        try:
            image = read_file(path, MAX_BYTES)
            device = read_sii(image, str(path))
        except EsiError as error:
            raise _mistake("sii", error) from error
        return device, partial(with_alias, image)


def _mistake(key: str, error: EsiError) -> OptionError:
    where: KeyPath = (key,)
    return OptionError(Finding(where, "description", text=str(error)))
