"""Descriptions of devices: ESI files (ETG.2000) and SII images (ETG.2010), read and written.

Used by the master's side and by the virtual segment; imports neither.
"""
