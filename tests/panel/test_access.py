"""Access to the panel, with requests that no browser would send: over real HTTP and WebSockets, and in process."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import http.client
import json
import os
import re
import resource
import shutil
import signal
import socket
import ssl
import stat
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast
from urllib.parse import urlencode, urlsplit

import pytest
from starlette.responses import PlainTextResponse
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from rtcp.api import Invalid
from rtcp.panel import access
from rtcp.panel.access import Listener
from tests.e2e.conftest import Platform
from tests.panel.conftest import begun
from tests.simulated_time import Clock
from tests.waiting import HANG_S, until

PAGE = {"Accept": "text/html"}
PASSWORDS = {"operator": "correct horse", "viewer": "battery staple"}


@pytest.fixture(scope="module")
def open_panel() -> Iterator[tuple[Platform, str]]:
    """A panel without passwords and without a platform, which a web browser is told to open."""
    platform = Platform()
    browser, opened = platform.directory / "browser", platform.directory / "opened"
    browser.write_text(f'#!/bin/sh\necho "$1" $$ >{opened}\nexec sleep 60 >/dev/null 2>&1\n')
    browser.chmod(0o700)
    platform.environment["BROWSER"] = f"{browser} %s"  # Python waits for one that is named so
    try:
        with begun(platform, "--open") as (_, url):
            yield platform, url
    finally:
        # After the panel, which would try the next browser.
        with contextlib.suppress(ProcessLookupError):
            os.kill(int(opened.read_text().split()[1]), signal.SIGKILL)
        platform.end()


@dataclass
class Answer:
    """The answer of the middleware to a request."""

    status: int
    headers: dict[str, str]
    text: str

    @property
    def cookie(self) -> str:
        return self.headers.get("set-cookie", "").partition(";")[0]


class Guarded:
    """The middleware before pages that are open to whoever reaches them, with passwords."""

    def __init__(self, file: Path) -> None:
        for role, password in PASSWORDS.items():
            access.set_password(file, cast(access.Role, role), password)
        self._access = access.Access(PlainTextResponse("a page"), access.Sessions(file), "127.0.0.1", False)

    def ask(self, method: str, path: str, headers: dict[str, str] | None = None, body: str = "") -> Answer:
        """Send one request from this machine."""
        sent: list[Any] = []
        fields = {"host": "localhost", **{name.lower(): value for name, value in (headers or {}).items()}}

        async def receive() -> Any:
            return {"type": "http.request", "body": body.encode(), "more_body": False}

        async def send(message: Any) -> None:
            sent.append(message)

        raw = [(name.encode(), value.encode("latin-1")) for name, value in fields.items()]
        scope = {"type": "http", "method": method, "path": path, "headers": raw, "client": ("127.0.0.1", 1)}
        asyncio.run(self._access(scope, receive, send))
        begin, *parts = sent
        heads = {name.decode(): value.decode() for name, value in begin["headers"]}
        return Answer(begin["status"], heads, b"".join(part.get("body", b"") for part in parts).decode())

    def log_in(self, password: str, origin: str = "http://localhost") -> Answer:
        body = urlencode({"name": "Ada", "password": password})
        return self.ask("POST", "/login", {"Origin": origin, "Content-Length": str(len(body))}, body)


@pytest.fixture
def guarded(tmp_path: Path) -> Guarded:
    return Guarded(tmp_path / "panel.json")


def ask(
    url: str,
    method: str,
    path: str,
    headers: dict[str, str] | None = None,
    body: str | None = None,
    context: ssl.SSLContext | None = None,
) -> Any:
    """Send one request; return the response, read."""
    place = urlsplit(url).netloc
    connection = (
        http.client.HTTPConnection(place, timeout=HANG_S)
        if context is None
        else http.client.HTTPSConnection(place, timeout=HANG_S, context=context)
    )
    connection.request(method, path, body, headers or {})
    response = connection.getresponse()
    response.text = response.read().decode(errors="replace")  # type: ignore[attr-defined]
    connection.close()
    return response


def cookie_of(response: Any) -> str:
    return str(response.getheader("set-cookie") or "").partition(";")[0]


def status_of_socket(url: str, path: str, **headers: str) -> int:
    try:
        with connect(url.replace("http", "ws") + path, additional_headers=headers):
            return 101
    except InvalidStatus as error:
        return error.response.status_code


def test_a_visitor_gets_a_cookie_that_no_script_and_no_other_site_can_use(open_panel: tuple[Platform, str]) -> None:
    response = ask(open_panel[1], "GET", "/", PAGE)
    assert response.status == 303
    assert re.search("HttpOnly", response.getheader("set-cookie"))
    assert re.search("SameSite=strict", response.getheader("set-cookie"))
    page = ask(open_panel[1], "GET", "/", {**PAGE, "Cookie": cookie_of(response)})
    assert page.status == 200
    assert "frame-ancestors 'none'" in page.getheader("content-security-policy")
    assert not re.search(r"""(src|href)=["']https?:""", page.text)


@pytest.mark.parametrize("path", ["/", "/live", "/metrics", "/static/panel.js", "/recordings/x.mcap"])
def test_nothing_is_served_without_a_session(guarded: Guarded, path: str) -> None:
    for cookie in ("", "rtcp_panel=" + "A" * 43, "rtcp_panel=../../etc", "rtcp_panel=" + "x" * 9000):
        assert guarded.ask("GET", path, {"Cookie": cookie}).status == 401
    assert guarded.ask("GET", path, {"Cookie": guarded.log_in("battery staple").cookie}).text == "a page"


def test_prometheus_needs_no_cookie_where_nobody_is_asked(open_panel: tuple[Platform, str]) -> None:
    assert "rtcp_up 0.0" in ask(open_panel[1], "GET", "/metrics").text
    assert ask(open_panel[1], "GET", "/static/panel.js").status == 401


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "10.0.0.1", "", "127.0.0.1.evil.example"])
def test_a_foreign_host_is_refused(open_panel: tuple[Platform, str], host: str) -> None:
    assert ask(open_panel[1], "GET", "/", {**PAGE, "Host": host}).status in (400, 403)


@pytest.mark.parametrize("path", ["/live?page=x", "/_nicegui_ws/socket.io/?EIO=4&transport=websocket"])
def test_a_socket_of_another_site_is_refused(open_panel: tuple[Platform, str], path: str) -> None:
    url = open_panel[1]
    cookie = cookie_of(ask(url, "GET", "/", PAGE))
    for origin in ("http://evil.example", "null", url.replace("http", "https"), url + ".evil.example"):
        assert status_of_socket(url, path, Cookie=cookie, Origin=origin) == 403
    assert status_of_socket(url, path, Cookie=cookie) == 403
    assert status_of_socket(url, path, Origin=url) == 403


def test_a_command_of_another_site_is_refused(open_panel: tuple[Platform, str]) -> None:
    url = open_panel[1]
    cookie = cookie_of(ask(url, "GET", "/", PAGE))
    for headers in ({}, {"Origin": "http://evil.example"}, {"Origin": "null"}):
        assert ask(url, "POST", "/stop", {"Cookie": cookie, **headers}).status == 403
    assert ask(url, "POST", "/stop", {"Cookie": cookie, "Origin": url}).status == 503  # no platform runs
    assert ask(url, "POST", "/stop", {"Cookie": cookie, "Origin": url, "Content-Length": "99999999"}).status == 413
    for method in ("PUT", "DELETE", "OPTIONS", "TRACE"):
        assert ask(url, method, "/", {"Cookie": cookie, "Origin": url}).status == 405


def test_no_file_outside_the_recordings_is_served(open_panel: tuple[Platform, str]) -> None:
    platform, url = open_panel
    cookie = {"Cookie": cookie_of(ask(url, "GET", "/", PAGE))}
    state = Path(platform.environment["RTCP_STATE_DIR"])
    (state / "recordings").mkdir(parents=True, exist_ok=True)
    (state / "recordings" / "mine.csv").write_text("Time\n")
    (state / "secret.csv").write_text("no")
    (state / "recordings" / "link.csv").symlink_to(state / "secret.csv")
    assert ask(url, "GET", "/recordings/mine.csv", cookie).text == "Time\n"
    for path in (
        "../secret.csv",
        "..%2fsecret.csv",
        "%2e%2e/secret.csv",
        "link.csv",
        "//etc/passwd",
        "%00",
        "a" * 5000,
    ):
        assert ask(url, "GET", f"/recordings/{path}", cookie).status in (400, 401, 404)


def test_passwords_open_the_panel(guarded: Guarded) -> None:
    assert guarded.ask("GET", "/", PAGE).headers["location"] == "/login"
    assert guarded.log_in("wrong").status == 401
    assert guarded.log_in("correct horse", "http://evil.example").status == 403
    response = guarded.log_in("correct horse")
    assert (response.status, response.headers["location"]) == (303, "/")
    assert guarded.ask("GET", "/", {**PAGE, "Cookie": response.cookie}).status == 200
    ended = guarded.ask("POST", "/logout", {"Cookie": response.cookie, "Origin": "http://localhost"})
    assert ended.status == 303
    assert guarded.ask("GET", "/metrics", {"Cookie": response.cookie}).status == 401


@pytest.mark.skipif(shutil.which("openssl") is None, reason="needs openssl")
def test_with_a_certificate_everything_is_encrypted(tmp_path: Path) -> None:
    certificate = tmp_path / "panel.pem"
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-days", "1",
         "-subj", "/CN=localhost", "-addext", "subjectAltName=IP:127.0.0.1",
         "-keyout", certificate, "-out", tmp_path / "public.pem"],
        check=True, capture_output=True,
    )  # fmt: skip
    certificate.write_text(certificate.read_text() + (tmp_path / "public.pem").read_text())
    trusted = ssl.create_default_context(cafile=tmp_path / "public.pem")
    platform = Platform()
    try:
        with begun(platform, "--certificate", str(certificate)) as (_, url):
            assert url.startswith("https://127.0.0.1:")
            response = ask(url, "GET", "/", PAGE, context=trusted)
            assert re.search("Secure", response.getheader("set-cookie"))
            cookie = {"Cookie": cookie_of(response)}
            assert ask(url, "POST", "/stop", {**cookie, "Origin": url}, context=trusted).status == 503
            plain = url.replace("https", "http")
            assert ask(url, "POST", "/stop", {**cookie, "Origin": plain}, context=trusted).status == 403
            # By hand: the synchronous client of websockets reads and writes TLS in two threads, and loses its request.
            upgrade = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13"}
            upgrade |= {"Sec-WebSocket-Key": base64.b64encode(bytes(16)).decode(), **cookie}
            socket = "/_nicegui_ws/socket.io/?EIO=4&transport=websocket"
            assert ask(url, "GET", socket, {**upgrade, "Origin": url}, context=trusted).status == 101
            assert ask(url, "GET", socket, {**upgrade, "Origin": plain}, context=trusted).status == 403
            with pytest.raises((http.client.HTTPException, OSError)):
                ask(plain, "GET", "/", PAGE)
    finally:
        platform.end()


def test_tries_are_limited(guarded: Guarded) -> None:
    with Clock().shown() as clock:
        assert [guarded.log_in("wrong").status for _ in range(6)] == [401] * 5 + [429]
        assert guarded.log_in("correct horse").status == 429
        clock.advance(60.0)
        assert guarded.log_in("correct horse").status == 303


def test_tries_from_many_addresses_lock_nobody_out_who_was_there_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "panel.json"
    access.set_password(file, "operator", "correct horse")
    sessions = access.Sessions(file)
    monkeypatch.setattr(access, "role_of", lambda kept, password: "operator" if password == "correct horse" else None)
    assert asyncio.run(sessions.log_in("Ada", "correct horse", "10.0.0.1"))
    for host in range(50):
        assert asyncio.run(sessions.log_in("", "wrong", f"10.0.1.{host}")) is None
    assert sessions.too_many_tries("10.0.2.1")
    assert not sessions.too_many_tries("10.0.0.1")
    assert not sessions.too_many_tries("127.0.0.1")


def test_many_requests_are_refused_and_others_are_still_served(guarded: Guarded) -> None:
    with Clock().shown() as clock:
        cookie = {"Cookie": guarded.log_in("battery staple").cookie}
        answers = [guarded.ask("GET", "/metrics") for _ in range(500)]
        served = sum(answer.status == 401 for answer in answers)
        assert served == pytest.approx(399, abs=1)
        assert [answer.status for answer in answers] == [401] * served + [429] * (500 - served)
        assert answers[-1].headers["connection"] == "close"
        assert guarded.ask("GET", "/metrics", cookie).status == 200
        clock.advance(0.5)
        assert [guarded.ask("GET", "/metrics").status for _ in range(60)].count(401) == pytest.approx(50, abs=1)


@pytest.mark.platform
def test_a_platform_is_started_with_its_panel_and_both_end_together() -> None:
    platform = Platform()
    platform.be_patient(lost_ms=2000)
    command = [sys.executable, "-m", "rtcp.cli", "start", "--panel", "--port", "0"]
    environment = {**platform.environment, "DISPLAY": "", "WAYLAND_DISPLAY": ""}
    running = subprocess.Popen(command, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        assert running.stdout is not None
        url, _, hint = running.stdout.readline().partition("/: ")
        assert hint == "Ctrl-C ends the panel\n"
        until(lambda: "rtcp_up 1.0" in ask(url, "GET", "/metrics").text, "the platform")
        running.send_signal(signal.SIGINT)
        _, complaints = running.communicate(timeout=HANG_S)
        assert (running.returncode, "Traceback" in complaints) == (0, False), complaints
        with pytest.raises(ConnectionRefusedError):
            ask(url, "GET", "/", PAGE)
    finally:
        running.kill()
        platform.end()


def test_a_busy_port_of_the_panel_refuses_the_start_before_the_platform() -> None:
    platform = Platform()
    try:
        with socket.create_server(("127.0.0.1", 0)) as busy:
            port = busy.getsockname()[1]
            refused = platform.rtcp("start", "--panel", "--port", str(port), check=3)
        assert refused.stderr.startswith(f"rtcp: 127.0.0.1 port {port} cannot be listened at")
        assert "--port" in refused.stderr
        assert (refused.stdout, list(platform.directory.iterdir())) == ("", [])
        assert "--panel" in platform.rtcp("start", "--port", "8081", check=2).stderr
    finally:
        platform.end()


def test_open_shows_the_panel_in_a_browser_and_does_not_wait_for_it(open_panel: tuple[Platform, str]) -> None:
    platform, url = open_panel
    opened = platform.directory / "opened"
    until(lambda: opened.exists() and opened.read_text(), "the browser")
    assert opened.read_text().split()[0].rstrip("/") == url
    assert ask(url, "GET", "/", PAGE).status == 303


def test_another_address_wants_a_password(tmp_path: Path) -> None:
    with pytest.raises(Invalid, match="rtcp panel password"):
        access.passwords_for("0.0.0.0", tmp_path / "panel.json")
    assert access.passwords_for("127.0.0.1", tmp_path / "panel.json") is None


def test_the_file_is_readable_by_its_owner_alone_and_a_damaged_one_is_said(tmp_path: Path) -> None:
    file = tmp_path / "state" / "panel.json"
    access.set_password(file, "viewer", "battery staple")
    access.set_password(file, "operator", "correct horse")
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert "horse" not in file.read_text()
    hashes = access.read_passwords(file)
    assert [access.role_of(hashes, password) for password in ("correct horse", "battery staple", "", "horse")] == [
        "operator", "viewer", None, None,
    ]  # fmt: skip
    with pytest.raises(Invalid, match="found 5 characters, allowed are 8"):
        access.set_password(file, "viewer", "short")
    file.chmod(0o644)
    with pytest.raises(Invalid, match="others may read it"):
        access.read_passwords(file)
    file.chmod(0o600)
    for text in ("", "[]", '{"operator": {}}', '{"root": {"salt": "00", "scrypt": "00"}}', json.dumps({"viewer": 1})):
        file.write_text(text)
        with pytest.raises(Invalid, match="damaged"):
            access.read_passwords(file)


# -- connections ------------------------------------------------------------------------------------------------------


@pytest.fixture
def listener() -> Iterator[Listener]:
    with Listener(socket.AF_INET) as made:
        made.bind(("127.0.0.1", 0))
        made.listen(2048)
        yield made


def is_ended(browser: socket.socket) -> bool:
    """Return whether the panel has ended a connection."""
    browser.setblocking(False)
    try:
        return browser.recv(1) == b""
    except BlockingIOError:
        return False


def test_connections_without_a_session_are_few_and_those_with_one_stay(listener: Listener) -> None:
    browsers, accepted = [], []
    for number in range(listener.MOST_STRANGERS + 10):
        browsers.append(socket.create_connection(listener.getsockname()))
        connection, address = listener.accept()
        accepted.append(connection)
        if number < 5:
            listener.admit(address)
    assert [is_ended(browser) for browser in browsers] == [False] * 5 + [True] * 5 + [False] * listener.MOST_STRANGERS
    for each in (*browsers, *accepted):
        each.close()


def test_a_connection_without_a_session_is_closed_after_a_time(
    listener: Listener, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Clock().shown() as clock, socket.create_connection(listener.getsockname()) as browser:
        connection, _ = listener.accept()
        clock.advance(listener.STRANGER_S - 0.1)
        listener.look_after()
        assert not is_ended(browser)
        clock.advance(0.2)
        listener.look_after()
        assert is_ended(browser)
        connection.close()


def test_a_connection_is_accepted_while_all_file_descriptors_are_used(listener: Listener) -> None:
    limit, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    browsers = [socket.create_connection(listener.getsockname()) for _ in range(3)]
    taken: list[int] = []
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (min(limit, 256), hard))
        with contextlib.suppress(OSError):
            while True:
                taken.append(os.open(os.devnull, os.O_RDONLY))
        accepted = [listener.accept()[0] for _ in browsers]
        assert [each.fileno() > 0 for each in accepted] == [True] * 3
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (limit, hard))
        for descriptor in taken:
            os.close(descriptor)
        for browser in browsers:
            browser.close()


def test_stop_needs_no_session_and_commands_do(tmp_path: Path) -> None:
    sessions = access.Sessions(tmp_path / "none")
    reached = []

    async def app(scope: Any, receive: Any, send: Any) -> None:
        reached.append((scope["method"], scope["path"], scope["visitor"]))
        await PlainTextResponse("")(scope, receive, send)

    guarded = access.Access(app, sessions, "127.0.0.1", False)

    async def ask(method: str, path: str, origin: str) -> None:
        headers = [(b"host", b"127.0.0.1:8080"), (b"origin", origin.encode())]
        scope = {"type": "http", "method": method, "path": path, "headers": headers, "client": ("10.0.0.1", 1)}

        async def receive() -> Any:
            return {"type": "http.request", "body": b""}

        async def send(message: Any) -> None:
            pass

        await guarded(scope, receive, send)

    for _ in range(1000):  # no limit of requests holds it back
        asyncio.run(ask("POST", "/stop", "http://127.0.0.1:8080"))
    asyncio.run(ask("POST", "/stop", "http://evil.example"))
    asyncio.run(ask("GET", "/stop", "http://127.0.0.1:8080"))
    asyncio.run(ask("POST", "/other", "http://127.0.0.1:8080"))
    assert reached == [("POST", "/stop", None)] * 1000
