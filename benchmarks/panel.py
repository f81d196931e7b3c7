"""What the panel costs and how soon the arm stops: `python benchmarks/panel.py [--rounds N] [--seconds N] [--json F]`.

A platform on its virtual segment, the panel beside it, headless Chromium in front. In one run: the time to the first
page; CPU and memory of the panel with one page; how old what it shows is; wake-up of the cycle without and with five
viewers, alternating, once as pages that Chromium draws on this machine and once as clients that answer as a page does
and draw nothing, like tablets elsewhere; the same while somebody sends 12 000 requests a second; and from losing the
browser, the panel or the operator's attention to the arm's standstill, while it is jogged and while it moves. Exit
code 1 where a figure misses its aim.

`--pictures DIR` writes a picture of every page at 400 and 1600 px instead, and of a cell that moves in
step. Needs Chromium, and what `pip install -e .[dev]` brings.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import platform
import re
import select
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from datetime import date
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import numpy as np
import psutil
from playwright.sync_api import Browser, Error, Page, Playwright, sync_playwright
from rich.console import Console
from rich.table import Table
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection
from websockets.sync.client import connect as connect_socket
from websockets.typing import Origin

sys.path.insert(0, str(Path(__file__).parents[1]))

from rtcp.api import Feed, connect
from rtcp.launch.launcher import StartOptions, start
from rtcp.panel.access import set_password
from rtcp.panel.server import PAGES
from tests.panel.cable import NEAR, Cable
from tests.panel.conftest import BENT, FLAGS, PASSWORD, log_in

WATCHED = ("/arm", "/jog", "/scope", "/segment", "/health")
REQUESTS_PER_S = 12_000
_BATCH, _SENDERS = 100, 4
HOLDING = "[data-live=state][data-state=holding]"
console = Console()


@contextlib.contextmanager
def panel(*arguments: str) -> Iterator[tuple[psutil.Process, str]]:
    command = [sys.executable, "-m", "rtcp.cli", "panel", "--port", "0", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        psutil.Process(process.pid).cpu_affinity(list(range(os.cpu_count() or 1)))
        yield psutil.Process(process.pid), process.stdout.readline().partition(": ")[0].rstrip("/")
    finally:
        process.terminate()
        process.wait()


def visit(browser: Browser, url: str, width: int = 1600) -> Page:
    return browser.new_context(base_url=url, viewport={"width": width, "height": 900}).new_page()


def opened(browser: Browser, url: str, path: str, width: int = 1600) -> Page:
    page = visit(browser, url, width)
    page.goto(path)
    page.wait_for_selector("[data-live=state][data-state]")
    return page


def wakeup_p99(seconds: float) -> float:
    with contextlib.closing(Feed()) as feed:
        parts, until = [], time.monotonic() + seconds
        while time.monotonic() < until:
            feed.ended(0.2)
            parts.append(feed.records()[0]["wakeup_ns"] / 1e3)
    return float(np.percentile(np.concatenate(parts), 99))


def alternating(
    rounds: int, seconds: float, other: Callable[[], contextlib.AbstractContextManager[object]]
) -> dict[str, list[float]]:
    found: dict[str, list[float]] = {"without": [], "with": []}
    for turn in range(rounds):
        for kind in list(found)[:: -1 if turn % 2 else 1]:
            with other() if kind == "with" else contextlib.nullcontext():
                found[kind].append(wakeup_p99(seconds))
    return found


@contextlib.contextmanager
def five_pages(browser: Browser, url: str) -> Iterator[None]:
    pages = [opened(browser, url, path) for path in WATCHED]
    yield
    for page in pages:
        page.context.close()


@contextlib.contextmanager
def five_clients(url: str) -> Iterator[None]:
    with contextlib.ExitStack() as stack:
        for path in WATCHED:
            asks = {"Accept": "text/html"}
            visitor = stack.enter_context(httpx.Client(base_url=url, headers=asks, follow_redirects=True))
            key = re.search(r"data-page\W+([\w-]+)", visitor.get(path).text)
            assert key is not None
            session = {"Cookie": "; ".join(f"{name}={value}" for name, value in visitor.cookies.items())}
            live = f"{url.replace('http', 'ws', 1)}/live?page={key[1]}"
            viewer = stack.enter_context(connect_socket(live, origin=Origin(url), additional_headers=session))
            threading.Thread(target=_watch, args=(viewer,), daemon=True).start()
        yield


def _watch(viewer: ClientConnection) -> None:
    """Answer each message with its token, as a page does."""
    with contextlib.suppress(ConnectionClosed):
        for message in viewer:
            viewer.send(json.dumps({"seen": json.loads(message).get("token", 0), "visible": True}))


@contextlib.contextmanager
def flood(url: str) -> Iterator[list[int]]:
    """Send `REQUESTS_PER_S` requests without a session, `_BATCH` at once over a connection; read what is answered."""
    count, ended, place = [0], threading.Event(), urlsplit(url)
    batch = f"GET /metrics HTTP/1.1\r\nHost: {place.netloc}\r\n\r\n".encode() * _BATCH

    def send() -> None:
        due = time.monotonic()
        while not ended.is_set():
            with contextlib.suppress(OSError), socket.create_connection((place.hostname, place.port), 5.0) as to:
                while not ended.is_set():
                    to.sendall(batch)
                    count[0] += _BATCH
                    due += _BATCH * _SENDERS / REQUESTS_PER_S
                    ended.wait(max(0.0, due - time.monotonic()))
                    while select.select([to], [], [], 0.0)[0]:
                        if not to.recv(1 << 16):
                            raise ConnectionError  # closed by the panel: connect again

    threads = [threading.Thread(target=send, daemon=True) for _ in range(_SENDERS)]
    for one in threads:
        one.start()
    yield count
    ended.set()
    for one in threads:
        one.join()


def age_ms(page: Page) -> list[float]:
    """How old the newest message is when the page draws, by the clock of one machine."""
    found = page.evaluate(
        "() => new Promise((done) => { const ages = [];"
        " const stop = rtcp.listen((state) => requestAnimationFrame(() => {"
        "  ages.push([state.token, performance.timeOrigin + performance.now()]);"
        "  if (ages.length === 100) { stop(); done(ages); } })); })"
    )
    ahead_ms = time.time() * 1e3 - time.monotonic() * 1e3
    return [drawn - token * 1e-6 - ahead_ms for token, drawn in found]


def jogging(page: Page) -> None:
    page.goto("/jog")
    page.wait_for_selector(HOLDING)
    page.get_by_label("Frame").select_option("joints")
    page.get_by_role("button", name="joint1 +").hover()
    page.mouse.down()


def moving(page: Page) -> None:
    page.goto("/targets")
    page.wait_for_selector(HOLDING)
    page.get_by_label("joint1, rad").fill("1.5")
    page.get_by_role("spinbutton", name="Speed").fill("0.15")
    page.get_by_role("button", name="Plan").click()
    page.get_by_role("button", name="Send", exact=True).click()


def let_go(page: Page, begin: Callable[[Page], None]) -> int:
    """Release the pad of a jog; press STOP in a move. Return when the browser got that, CLOCK_MONOTONIC, ns.

    Playwright waits for the screen before it clicks: for a few hundred ms where software draws the arm.
    """
    page.evaluate("addEventListener('pointerup', (e) => { letGo = performance.timeOrigin + e.timeStamp; }, true)")
    if begin is jogging:
        page.mouse.up()
    else:
        page.get_by_role("button", name="STOP not the emergency stop").click()
    ago_ns = time.time_ns() - int(page.evaluate("letGo") * 1e6)
    return time.monotonic_ns() - ago_ns


LOSSES = (
    "button released", "focus lost", "page overloaded", "browser stopped", "page closed", "browser killed",
    "panel killed",
)  # fmt: skip
NETWORKS = {"network cut": (0.0, 1.0), "network 0.3 s slow": (0.15, 0.0), "network loses a fifth": (0.0, 0.2)}
"""Delay, s, and loss of each way. The last two let a move go on: STOP is pressed as they begin, and the pad of a jog
released where a fifth is lost."""


def to_standstill(
    playwright: Playwright, loss: str, begin: Callable[[Page], None], cable: Cable | None = None
) -> float:
    """Return the time from the loss until the arm stands, ms; not a number where it had not moved."""
    chromium = cable.far(CHROMIUM, Path(os.environ["RTCP_STATE_DIR"])) if cable else CHROMIUM
    where = ("--host", NEAR) if cable else ()
    with panel(*where) as (process, url), contextlib.closing(Feed()) as feed, connect("benchmark") as robot:
        before = set(psutil.Process().children(recursive=True))
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        if cable:
            cable.delay_s, cable.loss = 0.0, 0.0
            page = visit(browser, url)
            log_in(page)
        else:
            page = opened(browser, url, "/")
        begin(page)
        until = time.monotonic() + 10
        while robot.state.name != "MOVING" and time.monotonic() < until:
            time.sleep(0.01)
        time.sleep(0.6)
        own = set(psutil.Process().children(recursive=True)) - before
        at_ns = time.monotonic_ns()
        if cable:
            cable.delay_s, cable.loss = NETWORKS[loss]
        if loss in ("button released", "network loses a fifth") or (loss == "network 0.3 s slow" and begin is moving):
            at_ns = let_go(page, begin)
        elif loss == "focus lost":
            page.evaluate("window.dispatchEvent(new Event('blur'))")
        elif loss == "page overloaded":
            page.evaluate("setTimeout(() => { const end = Date.now() + 3000; while (Date.now() < end) ; }, 0)")
        elif loss == "page closed":
            page.close()
        elif not cable:
            for one in {process} if loss == "panel killed" else own:
                with contextlib.suppress(psutil.Error):
                    one.suspend() if loss == "browser stopped" else one.kill()
        time.sleep(3.5)  # longer than the lease of a jog on a shared host
        records, _ = feed.records()
        if loss == "browser stopped":
            for one in own:
                with contextlib.suppress(psutil.Error):
                    one.resume()
        with contextlib.suppress(Error):
            browser.close()
        robot.halt()
        robot.move_joints(BENT)
    speed = np.abs(np.diff(records["commanded_position"][:, 0])) / (np.diff(records["time_ns"]) * 1e-9)
    times = (records["time_ns"][1:] - at_ns) * 1e-6
    moving_at = times[(times > 0) & (speed > 1e-6)]
    return float(moving_at[-1]) if len(moving_at) else float("nan")


_WITHOUT_PATHS = """([project, home]) => {
  for (const one of document.querySelectorAll("input"))
    one.value = one.value.replace(project, "~/rtcp").replace(home, "~");
}"""


@contextlib.contextmanager
def moved_by_another() -> Iterator[None]:
    """Move the first joint meanwhile, as somebody else does, and then back."""
    command = [sys.executable, "-m", "rtcp.cli", "move", "-1.2", *map(str, BENT[1:]), "--speed", "0.1"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    try:
        time.sleep(3.0)
        yield
    finally:
        process.terminate()
        process.wait()
        with connect("pictures") as robot:
            robot.halt()
            robot.move_joints(BENT)


def pictures(playwright: Playwright, directory: Path) -> None:
    directory.mkdir(parents=True, exist_ok=True)
    with panel() as (_, url):
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        for width in (400, 1600):
            for path in PAGES:
                if path in ("/cell", "/processes"):
                    continue
                page = opened(browser, url, path, width)
                if path == "/program":
                    teach(page)
                with moved_by_another() if path == "/arm" else contextlib.nullcontext():
                    time.sleep(2.5)
                    page.evaluate(_WITHOUT_PATHS, [str(Path(__file__).parents[1]), str(Path.home())])
                    page.screenshot(path=directory / f"panel-{path[1:] or 'start'}-{width}.png")
                page.context.close()
        browser.close()


def teach(page: Page) -> None:
    """Make a program of one step."""
    page.get_by_label("Program", exact=True).fill("cup")
    page.get_by_role("button", name="Open").click()
    page.get_by_label("Name of the pose").fill("above the cup")
    page.get_by_role("button", name="Keep where the arm is").click()
    page.get_by_role("button", name="Move to above the cup").wait_for()
    page.get_by_role("button", name="Add the step").click()
    page.get_by_text("above the cup is kept").wait_for(state="detached")
    page.evaluate("scrollTo(0, 0)")


def cell_picture(playwright: Playwright, directory: Path) -> None:
    """Write a picture of the page Cell while two virtual IRB 120 move in step."""
    directory.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "rtcp.cli", "cell"]
    subprocess.run([*command, "start", "--detach"], check=True)
    os.environ["RTCP_NAME"] = "left"
    try:
        subprocess.run([*command, "enable"], check=True)
        with panel() as (_, url), contextlib.closing(
            playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        ) as browser:  # fmt: skip
            page = opened(browser, url, "/cell")
            for name, q in {"left": "0.6, 0.3, 0.1, 0, 0.5, 0", "right": "-0.6, 0.3, 0.1, 0, 0.5, 0"}.items():
                page.get_by_label(f"Joints of {name}, rad").fill(q)
            page.get_by_label("Speed (empty: the limit), rad/s").fill("0.1")
            page.get_by_role("button", name="Move in step").click()
            time.sleep(4.0)
            page.screenshot(path=directory / "cell.png")
    finally:
        del os.environ["RTCP_NAME"]
        subprocess.run([*command, "stop"], check=True)


def running_cpu() -> int:
    """Return the CPU of the loop."""
    facts = json.loads((Path(os.environ["RTCP_RUNTIME_DIR"]) / "started.json").read_text())
    return int(facts["realtime"]["cpu"])


def spread(values: list[float]) -> str:
    return f"{statistics.median(values):.1f} ({min(values):.1f} to {max(values):.1f})"


CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or sys.exit("no Chromium is installed")


def losses_ms(playwright: Playwright, times: int) -> dict[str, list[float]]:
    """Measure each loss that many times, jogging and moving."""
    found: dict[str, list[float]] = {}

    def measure(loss: str, begin: Callable[[Page], None], cable: Cable | None = None) -> None:
        name = f"{loss}, {begin.__name__}"
        found[name] = [to_standstill(playwright, loss, begin, cable) for _ in range(times)]
        console.print(f"{name}: {found[name]}")

    for loss in LOSSES:
        measure(loss, jogging)
        if loss != "focus lost":
            measure(loss, moving)
    if os.geteuid():
        console.print("the network's rows want root: left out")
        return found
    set_password(Path(os.environ["RTCP_STATE_DIR"], "panel.json"), "operator", PASSWORD)
    with contextlib.closing(Cable("rtcp-bench")) as cable:
        for loss in NETWORKS:
            measure(loss, jogging, cable)
            measure(loss, moving, cable)
    return found


def costs(playwright: Playwright, rounds: int, seconds: float) -> dict[str, Any]:
    """Measure the first page, one page, and what five viewers and a flood cost the cycle."""
    found: dict[str, Any] = {}
    with panel() as (process, url):
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        opened(browser, url, "/").context.close()
        first = []
        for _ in range(5):
            began = time.monotonic()
            page = opened(browser, url, "/")
            first.append(time.monotonic() - began)
            page.context.close()
        page = opened(browser, url, "/arm")
        time.sleep(2.0)
        process.cpu_percent()
        time.sleep(10.0)
        found["cpu_percent"] = process.cpu_percent()
        found["memory_mb"] = process.memory_info().rss / 1e6
        found["first_page_s"] = first
        ages = age_ms(page)
        found["age_ms"] = [float(np.percentile(ages, part)) for part in (50, 99)]
        page.context.close()
        found["five pages"] = alternating(rounds, seconds, lambda: five_pages(browser, url))
        found["five clients"] = alternating(rounds, seconds, lambda: five_clients(url))
        counts: list[tuple[int, float]] = []

        @contextlib.contextmanager
        def counted() -> Iterator[None]:
            began = time.monotonic()
            with flood(url) as count:
                yield
            counts.append((count[0], time.monotonic() - began))

        found["flood"] = alternating(rounds, seconds, counted)
        found["requests_per_s"] = sum(one for one, _ in counts) / sum(took for _, took in counts)
        browser.close()
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=6.0, help="length of one round")
    parser.add_argument("--rounds", type=int, default=4, help="0: no costs")
    parser.add_argument("--losses", type=int, default=3, help="how often each loss is measured")
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    machine = f"{platform.machine()}, {os.cpu_count()} CPUs, Linux {platform.release()}"
    console.print(f"{machine}, {date.today().isoformat()}, load {os.getloadavg()[0]:.1f} before")
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(prefix="rtcp-bench-") as name, sync_playwright() as playwright:
        os.environ["RTCP_RUNTIME_DIR"] = os.environ["RTCP_STATE_DIR"] = name
        if given.pictures:
            cell_picture(playwright, given.pictures)
        running = start(StartOptions(), lambda sentence: None)
        try:
            with connect("benchmark") as robot:
                robot.enable()
                robot.move_joints(BENT)
            if given.pictures:
                pictures(playwright, given.pictures)
                return 0
            # Viewers are other machines: what stands for them keeps off the CPU of the loop.
            os.sched_setaffinity(0, set(range(os.cpu_count() or 1)) - {running_cpu()} or {0})
            if given.rounds:
                found |= costs(playwright, given.rounds, given.seconds)
            found["losses_ms"] = losses_ms(playwright, given.losses) if given.losses else {}
        finally:
            running.stop(lambda sentence: None)
    if given.json:
        given.json.write_text(json.dumps(found))
    return 1 if judge(found) else 0


def judge(found: dict[str, Any]) -> int:
    """Show every figure beside its aim; return how many miss theirs."""
    rows = Table("figure", "found", "aim", "")
    missed = 0

    def row(name: str, shown: str, value: float, aim: float) -> None:
        nonlocal missed
        is_met = value <= aim  # False for NaN, too
        missed += not is_met
        rows.add_row(name, shown, f"{aim:g}", "met" if is_met else "missed")

    if "first_page_s" in found:
        row("first page, s", spread(found["first_page_s"]), statistics.median(found["first_page_s"]), 2.0)
        row("one page, % of a core", f"{found['cpu_percent']:.0f}", found["cpu_percent"], 25.0)
        row("one page, MB", f"{found['memory_mb']:.0f}", found["memory_mb"], 150.0)
        middle, late = found["age_ms"]
        row("from message to picture, p50 and p99, ms", f"{middle:.0f}, {late:.0f}", late, 150.0)
        for name in ("five pages", "five clients", "flood"):
            without, with_it = found[name]["without"], found[name]["with"]
            ratio = statistics.median(with_it) / max(0.1, statistics.median(without))
            shown = f"{spread(with_it)} / {spread(without)} us: {ratio:.2f}"
            row(f"wake-up p99, {name} / without", shown, ratio, 1.1)
        console.print(f"flood: {found['requests_per_s']:.0f} requests/s")
    for name, values in found["losses_ms"].items():
        if name.endswith("jogging"):
            row(f"{name}: stands, ms", spread(values), statistics.median(values), 250.0)
        else:
            rows.add_row(f"{name}: stands, ms", spread(values), "", "")
    console.print(rows)
    return missed


if __name__ == "__main__":
    raise SystemExit(main())
