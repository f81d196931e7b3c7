"""Descriptions of devices: ESI files (ETG.2000) and SII images (ETG.2010), read and written.

Used by the master's side and by the virtual segment; imports neither. `model` defines a device; `reader.read_esi` and
`sii.read_sii` return it, `modules.assemble` inserts modules, `dictionary.complete` adds missing objects, and
`sii.write_sii` writes its EEPROM; `types` and `units` interpret its values.
"""
