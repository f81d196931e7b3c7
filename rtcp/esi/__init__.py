"""Descriptions of devices: ESI files (ETG.2000) and SII images (ETG.2010), read and written.

Used by the master's side and by the virtual segment; imports neither. `model` has what a device is; `reader.read_esi`
and `sii.read_sii` give it, `modules.assemble` puts modules into it, `dictionary.complete` fills in its objects,
`sii.write_sii` writes its EEPROM; `types` and `units` tell what its values are.
"""
