"""The service under a real systemd, PID 1 in namespaces and on a root of its own: an overlay that ends with the test.

Needs root, systemd 247 or newer, overlayfs and cgroup v2. `make test-all` runs it.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

ROOT = Path(__file__).parents[2]
SYSTEMD = Path("/lib/systemd/systemd")
UNIT = "rtcp@virtual"
HERE = ["env", "RTCP_RUNTIME_DIR=/run/rtcp/virtual", "RTCP_STATE_DIR=/var/lib/rtcp"]
CGROUPS = next((path for path in map(Path, ("/sys/fs/cgroup", "/sys/fs/cgroup/unified"))
                if (path / "cgroup.procs").exists() and (path / "cgroup.controllers").exists()), None)  # fmt: skip

pytestmark = [
    pytest.mark.platform,
    pytest.mark.long("test_it_is_ready_after_op_and_pings_only_while_the_cycle_goes_on"),
    pytest.mark.timeout(600),
    pytest.mark.skipif(os.geteuid() != 0, reason="systemd as PID 1 needs root: run `make test-all` as root"),
    pytest.mark.skipif(not SYSTEMD.exists(), reason="systemd is not installed: `apt-get install systemd`"),
    pytest.mark.skipif(CGROUPS is None, reason="no cgroup v2 is mounted: `mount -t cgroup2 cgroup2 /sys/fs/cgroup`"),
]

BOOT = """
set -e
mount --make-rprivate /
mount -t tmpfs tmpfs "$BASE"
mkdir "$BASE/upper" "$BASE/work" "$BASE/root"
mount -t overlay overlay -o "lowerdir=/,upperdir=$BASE/upper,workdir=$BASE/work" "$BASE/root"
cd "$BASE/root"
mkdir -p opt/rtcp/python opt/rtcp/site opt/rtcp/source dev proc sys run tmp old
mount --bind "$PREFIX" opt/rtcp/python
mount --bind "$SITE" opt/rtcp/site
mount --bind "$SOURCE" opt/rtcp/source
mount -t proc proc proc
mount -t sysfs sysfs sys
mount -t tmpfs tmpfs sys/fs/cgroup
mount -t cgroup2 cgroup2 sys/fs/cgroup
mount -t tmpfs tmpfs run
mount -t tmpfs tmpfs tmp
mount -t tmpfs -o mode=755 tmpfs dev
mkdir dev/pts dev/shm dev/net
mount -t devpts -o newinstance,ptmxmode=666 devpts dev/pts
mount -t tmpfs tmpfs dev/shm
for node in null zero full random urandom tty net/tun cpu_dma_latency; do
    if [ -e /dev/$node ]; then : > dev/$node; mount --bind /dev/$node dev/$node; fi
done
ln -s pts/ptmx dev/ptmx
# The overlay starts the service alone, nothing else of this machine.
rm -rf etc/systemd/system/*.wants etc/machine-id
: > etc/machine-id
cat > usr/bin/rtcp << END
#!/bin/sh
export PYTHONPATH=/opt/rtcp/source:/opt/rtcp/site LD_LIBRARY_PATH=/opt/rtcp/python/lib PYTHONDONTWRITEBYTECODE=1
exec /opt/rtcp/python/bin/$PYTHON -m rtcp.cli "\\$@"
END
chmod 755 usr/bin/rtcp
# A shared host takes the CPU away for long: the segment is not SCHED_FIFO in there.
mkdir -p etc/rtcp
cp -r opt/rtcp/source/config/* etc/rtcp
sed -i 's/period_us: 500 /period_us: 2000 /' etc/rtcp/assistive_arm.yaml
pivot_root . old
cd /
umount -l old
rtcp service install --program /usr/bin/rtcp > /dev/null
systemd-sysusers rtcp.conf
exec env -i container=lxc PATH=/usr/sbin:/usr/bin:/sbin:/bin LANG=C.UTF-8 "$SYSTEMD" --unit=basic.target
"""


class Machine:
    """A booted systemd and what its administrator types."""

    def __init__(self, base: Path) -> None:
        assert CGROUPS is not None
        self._cgroup = CGROUPS / base.name
        self._cgroup.mkdir()
        environment = {
            "PATH": os.environ["PATH"], "BASE": str(base), "SOURCE": str(ROOT), "PREFIX": sys.base_prefix,
            "PYTHON": f"python{sys.version_info.major}.{sys.version_info.minor}",
            "SITE": str(Path(psutil.__file__).parents[1]), "SYSTEMD": str(SYSTEMD),
        }  # fmt: skip
        join = f'echo $$ > "{self._cgroup}/cgroup.procs"; exec "$@"'
        # A test run that is killed leaves nothing running either.
        supervised = ["setpriv", "--pdeathsig", "KILL", "unshare", "--fork", "--kill-child"]
        apart = ["--pid", "--mount", "--uts", "--ipc", "--cgroup", "--net"]
        self._console = base.with_suffix(".log")
        with open(self._console, "wb") as log:
            self._unshare = subprocess.Popen(
                ["sh", "-c", join, "sh", *supervised, *apart, "sh", "-c", BOOT],
                env=environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log,
            )  # fmt: skip

    @property
    def pid_1(self) -> int:
        """Process id of the booted systemd, as it is outside."""
        (child,) = psutil.Process(self._unshare.pid).children()
        return int(child.pid)

    def run(self, *command: str, check: bool = True) -> str:
        """Run a command in there as root; return what it prints."""
        inside = ["nsenter", "-t", str(self.pid_1), "--all", "--", *HERE]
        done = subprocess.run([*inside, *command], capture_output=True, text=True, check=False, timeout=240)
        if check:
            assert done.returncode == 0, f"{command}: {done.stdout}{done.stderr}\n{self.journal()}"
        return done.stdout

    def property(self, name: str) -> str:
        """Return a property of the service, as `systemctl show` has it."""
        return self.run("systemctl", "show", "--value", "--property", name, UNIT).strip()

    def pids(self) -> dict[str, str]:
        """Return the service's processes by their module, with the ids that they have in there."""
        names = {"rtcp.cli": "main", "rtcp.virtual": "segment", "rtcp.control.process": "loop",
                 "rtcp.gateway.server": "gateway"}  # fmt: skip
        lines = [line.split() for line in self.run("ps", "-eo", "pid=,args=").splitlines()]
        return {names[words[3]]: words[0] for words in lines if words[2:3] == ["-m"] and words[3] in names}

    def journal(self) -> str:
        """Return the service's entries."""
        return self.run("journalctl", "--no-pager", "-o", "short-monotonic", "-u", UNIT, check=False)

    def until(self, met: Callable[[], bool], what: str, timeout_s: float = 60.0) -> None:
        end = time.monotonic() + timeout_s
        while not met():
            assert time.monotonic() < end, f"{what}\n{self.journal()}"
            time.sleep(0.1)

    def boot(self) -> None:
        """Wait until basic.target is reached."""
        end = time.monotonic() + 120
        while True:
            booting = self._unshare.poll() is None and time.monotonic() < end
            assert booting, self._console.read_text()
            with contextlib.suppress(ValueError, psutil.Error):
                if self.run("systemctl", "is-active", "basic.target", check=False).strip() == "active":
                    return
            time.sleep(0.2)

    def shut_down(self) -> None:
        """End every process in there and remove the control group."""
        with contextlib.suppress(ValueError, psutil.Error):
            os.kill(self.pid_1, signal.SIGKILL)  # the kernel ends all others of its namespace with it
        self._unshare.wait(30)
        for path in sorted(self._cgroup.rglob("*"), reverse=True):
            if path.is_dir():
                path.rmdir()
        self._cgroup.rmdir()


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    base = tmp_path_factory.mktemp("rtcp-systemd")
    made = Machine(base)
    try:
        made.boot()
        yield made
    finally:
        made.shut_down()
        shutil.rmtree(base)


@pytest.fixture
def service(machine: Machine) -> Iterator[Machine]:
    """A machine on which the service is ready; afterwards it is stopped and its entries are forgotten."""
    machine.run("systemctl", "start", UNIT)
    yield machine
    machine.run("systemctl", "stop", UNIT)
    machine.run("systemctl", "reset-failed", UNIT, check=False)
    machine.run("journalctl", "--rotate", "--vacuum-time=1us")


def test_start_returns_when_the_slaves_are_in_op_and_the_status_text_is_the_state(service: Machine) -> None:
    assert service.property("ActiveState") == "active"
    service.until(lambda: service.property("StatusText") == "ready", "the state is not in StatusText")
    assert service.pids().keys() == {"main", "segment", "loop", "gateway"}
    assert '"state": "ready"' in service.run("rtcp", "status", "--json")


def test_stop_ends_every_process_in_order_and_the_journal_has_it(service: Machine) -> None:
    service.run("systemctl", "stop", UNIT)
    assert (service.property("Result"), service.property("ExecMainStatus")) == ("success", "0")
    assert service.pids() == {}
    journal = service.journal()
    assert "all slaves in OP" in journal
    assert "stopped, but" not in journal


def test_the_watchdog_ends_a_service_whose_loop_hangs(service: Machine) -> None:
    service.run("kill", "-STOP", service.pids()["loop"])
    service.until(lambda: service.property("ActiveState") == "failed", "the watchdog did not end the service")
    assert service.property("Result") == "watchdog"
    service.until(lambda: service.pids() == {}, "processes are left")
    assert "Watchdog timeout" in service.journal()


def test_a_killed_loop_ends_the_service_with_a_fault(service: Machine) -> None:
    service.run("kill", "-KILL", service.pids()["loop"])
    service.until(lambda: service.property("ActiveState") == "failed", "the service goes on without its loop")
    assert (service.property("Result"), service.property("ExecMainStatus")) == ("exit-code", "5")
    assert service.pids() == {}
    assert "the loop" in service.journal()


def test_a_killed_gateway_is_restarted_and_the_service_goes_on(service: Machine) -> None:
    before = service.pids()
    service.run("kill", "-KILL", before["gateway"])
    service.until(lambda: "answers again" in service.journal(), "no gateway answers again")
    after = service.pids()
    assert after["gateway"] != before["gateway"]
    assert after["loop"] == before["loop"]
    assert service.property("ActiveState") == "active"


def test_a_killed_segment_is_a_fault_of_the_machine_and_the_service_can_be_stopped(service: Machine) -> None:
    service.run("kill", "-KILL", service.pids()["segment"])
    service.until(lambda: service.property("StatusText") == "fault", "the loop does not notice the lost bus")
    assert service.property("ActiveState") == "active"


def test_a_killed_main_process_takes_the_others_along_and_the_next_start_records_it(service: Machine) -> None:
    service.run("systemctl", "kill", "--kill-whom=main", "--signal=KILL", UNIT)
    service.until(lambda: service.property("ActiveState") == "failed", "the service goes on without its main process")
    assert service.property("Result") == "signal"
    service.until(lambda: service.pids() == {}, "processes are left")
    service.run("systemctl", "start", UNIT, check=False)  # it records before it opens the bus
    assert "black box: this fault is number" in service.journal()
    assert "the loop" in service.run("rtcp", "faults")


def test_the_panel_of_an_instance_serves_its_platform_and_outlives_it(service: Machine) -> None:
    ask = ["/opt/rtcp/python/bin/python3", "-c", "import urllib.request as net, sys\n"
           "print(net.urlopen('http://127.0.0.1:8080/metrics', timeout=5).read().decode())"]  # fmt: skip
    service.run("ip", "link", "set", "lo", "up")
    service.run("systemctl", "start", "rtcp-panel@virtual")
    service.until(lambda: 'rtcp_state{state="ready"} 1.0' in service.run(*ask, check=False), "no panel answers")
    service.run("systemctl", "stop", UNIT)
    service.until(lambda: "rtcp_up 0.0" in service.run(*ask, check=False), "the panel does not notice the end")
    assert service.run("systemctl", "is-active", "rtcp-panel@virtual").strip() == "active"
    service.run("systemctl", "stop", "rtcp-panel@virtual")
