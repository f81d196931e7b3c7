"""The lines that make a change last: the kernel's command line, sysctl, a file written at boot."""

from __future__ import annotations

from rtcp.realtime.doctor.host import Host

_SYSCTL_FILE = "/etc/sysctl.d/90-rtcp.conf"
TMPFILES = "/etc/tmpfiles.d/rtcp-host.conf"
"""Of the host's owner; the service has a file of its own beside it."""
_BOOT_FILES = (
    # Jetson and other boards of U-Boot's extlinux; Raspberry Pi; GRUB.
    ("/boot/extlinux/extlinux.conf", "sed -i '/^ *APPEND /s/$/ {words}/' {file}"),
    ("/boot/firmware/cmdline.txt", "sed -i '1s/$/ {words}/' {file}"),
    ("/etc/default/grub", "sed -i 's/^GRUB_CMDLINE_LINUX=\"/&{words} /' {file} && update-grub"),
)


def kernel_arguments(host: Host, words: str) -> tuple[str, ...]:
    """Return how words get onto the kernel's command line of this host."""
    for file, command in _BOOT_FILES:
        if host.exists(file):
            return (f"{command.format(words=words, file=file)}   # then reboot",)
    return (f"# in the boot loader's settings, then reboot: add to the kernel's command line: {words}",)


def sysctl(setting: str) -> tuple[str, ...]:
    """Return how a setting, as "vm.swappiness=0", is made now and kept after a restart."""
    return (f"sysctl -w {setting}", f"echo '{setting}' >> {_SYSCTL_FILE}   # kept after a restart")


def at_boot(path: str, value: str) -> str:
    """Return the line that has systemd write a value into a file of /sys at every boot."""
    return f"echo 'w {path} - - - - {value}' >> {TMPFILES}   # kept after a restart"
