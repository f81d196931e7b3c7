"""Access to the panel: sessions, roles, passwords, and requests that are refused before they reach a page.

Without a password file every visitor is an operator, and it listens at loopback only. A request is refused
where its Host is no name of this machine (DNS rebinding), where its Origin is another site's, where its cookie names no
session, and where one visitor sends too many. STOP is refused for the first two reasons only.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import hashlib
import hmac
import html
import ipaddress
import json
import os
import re
import secrets
import socket
import stat
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal, get_args
from urllib.parse import parse_qs, urlsplit

from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from rtcp.api import RtcpError
from rtcp.config.zero import state_directory

Role = Literal["operator", "viewer"]
ROLES: tuple[Role, ...] = get_args(Role)
COOKIE = "rtcp_panel"
SHORTEST_PASSWORD = 8
_SCRYPT = {"n": 1 << 14, "r": 8, "p": 1}
"""RFC 7914: 16 MiB and some 50 ms a try."""
_SESSION_S = 12 * 3600.0
_MOST_SESSIONS = 256
_BURST, _RATE = 400.0, 100.0
"""Requests of one visitor: burst, and per second."""
_MOST_BYTES = 64 << 10
"""Largest request body, bytes."""
_TRIES, _TRIES_S = 5, 60.0
"""Wrong passwords of one address in a minute; of all untrusted addresses together, ten times as many."""
_LONGEST_NAME = 32
_HEADERS = [
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"same-origin"),
    # The framework's pages have inline scripts and styles; nothing comes from or goes to another host.
    (
        b"content-security-policy",
        b"default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; frame-ancestors 'none'",
    ),
]


# -- passwords ------------------------------------------------------------------------------------------------------


def password_file() -> Path:
    """Return the path of the file with the passwords' hashes."""
    return state_directory() / "panel.json"


def set_password(path: Path, role: Role, password: str) -> None:
    """Keep the hash of a role's password in a file of mode 0600.

    Raises:
        Invalid: it is shorter than `SHORTEST_PASSWORD`.
        OSError: the file cannot be written.
    """
    if len(password) < SHORTEST_PASSWORD:
        message = f"password: found {len(password)} characters, allowed are {SHORTEST_PASSWORD} and more"
        raise RtcpError("invalid", message)
    hashes = read_passwords(path) if path.exists() else {}
    salt = secrets.token_bytes(16)
    hashes[role] = {"salt": salt.hex(), "scrypt": _hash(password, salt).hex()}
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    fresh = path.with_suffix(".new")
    fresh.unlink(missing_ok=True)
    with open(os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600), "w") as file:
        json.dump(hashes, file)
    fresh.replace(path)


def read_passwords(path: Path) -> dict[str, dict[str, str]]:
    """Return the hashes by role.

    Raises:
        Invalid: the file is damaged, or others may read it.
        OSError: it cannot be read.
    """
    if stat.S_IMODE(path.stat().st_mode) & 0o077:
        raise RtcpError("invalid", f"{path}: others may read it, allowed is mode 0600: `chmod 600 {path}`")
    try:
        hashes = json.loads(path.read_text())
        for role, entry in hashes.items():
            if role not in ROLES or len(bytes.fromhex(entry["salt"])) < 8 or len(bytes.fromhex(entry["scrypt"])) != 32:
                raise ValueError(role)
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        message = f"{path}: it is damaged ({error}): remove it, then `rtcp panel password`"
        raise RtcpError("invalid", message) from error
    return dict(hashes)


def role_of(passwords: dict[str, dict[str, str]], password: str) -> Role | None:
    """Return the role of a password; every hash is computed, so that the time reveals nothing."""
    match: Role | None = None
    for role in ROLES:
        if role in passwords:
            entry = passwords[role]
            if hmac.compare_digest(_hash(password, bytes.fromhex(entry["salt"])), bytes.fromhex(entry["scrypt"])):
                match = match or role
    return match


def _hash(password: str, salt: bytes) -> bytes:
    return hashlib.scrypt(password.encode(errors="replace"), salt=salt, dklen=32, **_SCRYPT)


# -- visitors -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Visitor:
    """The holder of a session."""

    name: str
    role: Role
    address: str
    since: float

    def __str__(self) -> str:
        return f"{self.name} at {self.address}"


@dataclass
class Bucket:
    """Token bucket: the requests that one visitor may still send."""

    most: float = _BURST
    rate: float = _RATE
    left: float = 0.0
    at: float = field(default_factory=time.monotonic)

    def __post_init__(self) -> None:
        self.left = self.most

    def allows(self) -> bool:
        """Count one request; return whether it is allowed."""
        now = time.monotonic()
        self.left = min(self.most, self.left + (now - self.at) * self.rate) - 1.0
        self.at = now
        if self.left < 0.0:
            self.left = 0.0
            return False
        return True


class Sessions:
    """The sessions by their secret, which only a cookie carries.

    Args:
        passwords: the file of `read_passwords`; None: no password is needed.
    """

    def __init__(self, passwords: Path | None) -> None:
        self._passwords = passwords
        self._sessions: dict[str, Visitor] = {}
        self._failures: list[tuple[float, str]] = []
        self._trusted = {"127.0.0.1", "::1"}
        """This machine, and addresses that have logged in: failures elsewhere do not lock them out."""
        self._numbers = 0
        self._local = self.begin("local", "operator", "this machine") if passwords is None else ""

    @property
    def asks(self) -> bool:
        """Whether a password is needed."""
        return self._passwords is not None

    @property
    def local(self) -> str:
        """Secret of the shared session where no password is needed; it lasts as long as the panel."""
        return self._local

    def find(self, secret: str) -> Visitor | None:
        """Return the visitor of a session; None: there is none, or it has expired."""
        visitor = self._sessions.get(secret)
        if visitor is not None and self.asks and time.monotonic() - visitor.since > _SESSION_S:
            del self._sessions[secret]
            return None
        return visitor

    def begin(self, name: str, role: Role, address: str) -> str:
        """Begin a session; return its secret."""
        self._numbers += 1
        label = "".join(letter for letter in name.strip() if letter.isprintable())[:_LONGEST_NAME]
        while len(self._sessions) >= _MOST_SESSIONS:
            # Of the same role first: viewers cannot throw an operator out.
            same = (key for key, visitor in self._sessions.items() if visitor.role == role)
            del self._sessions[next(same, next(iter(self._sessions)))]
        secret = secrets.token_urlsafe(32)
        self._sessions[secret] = Visitor(label or f"visitor {self._numbers}", role, address, time.monotonic())
        return secret

    def end(self, secret: str) -> None:
        """End a session."""
        self._sessions.pop(secret, None)

    def too_many_tries(self, address: str) -> bool:
        """Return whether an address has to wait before its next try."""
        since = time.monotonic() - _TRIES_S
        self._failures = [failure for failure in self._failures if failure[0] > since]
        if sum(source == address for _, source in self._failures) >= _TRIES:
            return True
        return address not in self._trusted and len(self._failures) >= 10 * _TRIES

    async def log_in(self, name: str, password: str, address: str) -> str | None:
        """Return the secret of a new session; None: the password is wrong."""
        if self._passwords is None:
            return None
        # Counted before it is known to be wrong: many tries at once count, too.
        failure = (time.monotonic(), address)
        self._failures.append(failure)
        role = await asyncio.to_thread(role_of, read_passwords(self._passwords), password)
        if role is None:
            return None
        with contextlib.suppress(ValueError):
            self._failures.remove(failure)
        self._trusted.add(address)
        return self.begin(name, role, address)


# -- requests -------------------------------------------------------------------------------------------------------


class Listener(socket.socket):
    """The socket that listens for browsers: connections without a session are few and short, so that STOP gets one.

    Args:
        family: AF_INET or AF_INET6.
    """

    MOST_STRANGERS: Final = 64
    """Most connections without a session; beyond, the oldest is closed."""
    STRANGER_S: Final = 10.0
    """Longest time of a connection without a session, s."""
    RESERVE: Final = 16
    """File descriptors that are kept for new connections while the process has no other ones left."""

    def __init__(self, family: int) -> None:
        super().__init__(family, socket.SOCK_STREAM)
        self.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._strangers: dict[tuple[Any, ...], tuple[socket.socket, float]] = {}
        """Connection and instant of its beginning, s, by address, oldest first."""
        self._reserve: list[int] = []
        self.look_after()

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept a connection; it is a stranger's until `admit`."""
        try:
            connection, address = super().accept()
        except OSError as error:
            if error.errno not in (errno.EMFILE, errno.ENFILE) or not self._reserve:
                raise
            os.close(self._reserve.pop())
            self._close_oldest()
            connection, address = super().accept()
        self._strangers[tuple(address[:2])] = connection, time.monotonic()
        if len(self._strangers) > self.MOST_STRANGERS:
            self._forget_closed()
        if len(self._strangers) > self.MOST_STRANGERS:
            self._close_oldest()
        return connection, address

    def admit(self, address: Sequence[Any]) -> None:
        """Note that a connection has sent a request of a session."""
        self._strangers.pop(tuple(address[:2]), None)

    def look_after(self) -> None:
        """Close the strangers whose time is over and fill the reserve; called repeatedly."""
        self._forget_closed()
        since = time.monotonic() - self.STRANGER_S
        while self._strangers and next(iter(self._strangers.values()))[1] < since:
            self._close_oldest()
        with contextlib.suppress(OSError):
            while len(self._reserve) < self.RESERVE:
                self._reserve.append(os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC))

    def _forget_closed(self) -> None:
        for address in [address for address, (stranger, _) in self._strangers.items() if stranger.fileno() < 0]:
            del self._strangers[address]

    def _close_oldest(self) -> None:
        if self._strangers:
            stranger, _ = self._strangers.pop(next(iter(self._strangers)))
            with contextlib.suppress(OSError):
                stranger.shutdown(socket.SHUT_RDWR)  # the event loop then closes it


class Access:
    """ASGI middleware: lets a request through that has a session, as `scope["visitor"]` and `scope["secret"]`.

    STOP needs no session: a page whose session has expired must still stop the arm.

    Args:
        app: behind it.
        sessions: kept here.
        host: the address that the panel listens at.
        secure: it is reached over TLS.
        admit: called with the client's address of a request that has a session.
    """

    def __init__(
        self,
        app: ASGIApp,
        sessions: Sessions,
        host: str,
        secure: bool,
        admit: Callable[[Sequence[Any]], None] = lambda address: None,
    ) -> None:
        self._app = app
        self._admit = admit
        self._sessions = sessions
        self._only_loopback = is_loopback(host)
        self._names = {"localhost"}
        if not self._only_loopback:
            self._names |= {host.lower(), socket.gethostname().lower(), f"{socket.gethostname().lower()}.local"}
        self._secure = secure
        self._buckets: dict[str, Bucket] = {}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or pass it on."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = {key: value.decode("latin-1") for key, value in scope["headers"]}
        address = scope["client"][0] if scope.get("client") else "unknown"
        secret = _cookie(headers.get(b"cookie", ""))
        visitor = self._sessions.find(secret)
        is_stop = scope["type"] == "http" and scope["path"] == "/stop" and scope["method"] == "POST"
        if not is_stop and not self._may_send(secret if visitor else address):
            await self._refuse(scope, receive, send, 429, "too many requests: wait a second")
            return
        if why := self._foreign(scope, headers):
            await self._refuse(scope, receive, send, 403, why)
            return
        if scope["type"] == "http":
            response = await self._respond(scope, receive, headers, address, visitor, secret, is_stop)
            if response is not None:
                await response(scope, receive, _with_headers(send))
                return
        visitor = visitor or scope.get("visitor")
        if visitor is not None and scope.get("client"):
            self._admit(scope["client"])
        if visitor is None and not is_stop:
            await self._refuse(scope, receive, send, 401, "no session: open the panel's first page")
            return
        scope["visitor"], scope["secret"] = visitor, secret
        await self._app(scope, receive, _with_headers(send))

    def _may_send(self, key: str) -> bool:
        if len(self._buckets) > 4 * _MOST_SESSIONS:
            self._buckets.clear()
        return self._buckets.setdefault(key, Bucket()).allows()

    def _foreign(self, scope: Scope, headers: dict[bytes, str]) -> str:
        """Return the reason why a request is foreign to this panel; empty: it is not, or it is harmless."""
        host = headers.get(b"host", "").lower()
        name = urlsplit(f"//{host}").hostname or ""
        try:
            address = ipaddress.ip_address(name)
            known = address.is_loopback or not self._only_loopback
        except ValueError:
            known = name in self._names
        if not known:
            return "the Host of the request is no name of this panel"
        origin = headers.get(b"origin")
        if origin is None:
            if scope["type"] == "websocket" or scope["method"] not in ("GET", "HEAD"):
                return "the request has no Origin"
            return ""
        wanted = f"{'https' if self._secure else 'http'}://{host}"
        return "" if origin.lower() == wanted else "the request comes from another site"

    async def _respond(
        self,
        scope: Scope,
        receive: Receive,
        headers: dict[bytes, str],
        address: str,
        visitor: Visitor | None,
        secret: str,
        is_stop: bool,
    ) -> Response | None:
        """Return the response to a request that needs no page; None: a page answers it."""
        path, method = scope["path"], scope["method"]
        if method not in ("GET", "HEAD", "POST"):
            return PlainTextResponse("method not allowed", 405)
        length = headers.get(b"content-length", "0")
        if not length.isdecimal() or int(length) > _MOST_BYTES or b"transfer-encoding" in headers:
            return PlainTextResponse(f"the body is longer than {_MOST_BYTES} bytes, or of unknown length", 413)
        if path == "/logout" and method == "POST":
            self._sessions.end(secret)
            return RedirectResponse("/login", 303)
        if path == "/login" and self._sessions.asks:
            return await self._log_in(receive, address) if method == "POST" else _login_page("")
        if visitor is not None or is_stop:
            return None
        if path == "/metrics" and method == "GET" and not self._sessions.asks:
            # Prometheus keeps no cookies; its client could open the page as well.
            scope["visitor"] = self._sessions.find(self._sessions.local)
            return None
        if self._sessions.asks:
            wants_page = method == "GET" and "text/html" in headers.get(b"accept", "")
            return RedirectResponse("/login", 303) if wants_page else None
        if method != "GET" or "text/html" not in headers.get(b"accept", ""):
            return None
        # Never to a path with two leading slashes, which names another host.
        return self._welcome(RedirectResponse("/" + path.strip("/"), 303), self._sessions.local)

    async def _log_in(self, receive: Receive, address: str) -> Response:
        if self._sessions.too_many_tries(address):
            return _login_page("Too many tries. Wait a minute.", 429)
        body = b""
        while True:
            message = await receive()
            body += message.get("body", b"")
            if len(body) > _MOST_BYTES or message["type"] == "http.disconnect":
                return PlainTextResponse("too long", 413)
            if not message.get("more_body"):
                break
        form = parse_qs(body.decode(errors="replace"))
        try:
            secret = await self._sessions.log_in(form.get("name", [""])[0], form.get("password", [""])[0], address)
        except (RtcpError, OSError) as error:
            return _login_page(f"The password file cannot be used: {error}", 500)
        if secret is None:
            return _login_page("The password is wrong.", 401)
        return self._welcome(RedirectResponse("/", 303), secret)

    def _welcome(self, response: Response, secret: str) -> Response:
        response.set_cookie(
            COOKIE, secret, max_age=int(_SESSION_S), httponly=True, samesite="strict", secure=self._secure
        )
        return response

    async def _refuse(self, scope: Scope, receive: Receive, send: Send, status: int, why: str) -> None:
        if scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008, "reason": why})
        else:
            # A visitor that sends too much has to connect again; its pending input is not read.
            headers = {"connection": "close"} if status == 429 else None
            await PlainTextResponse(why, status, headers)(scope, receive, _with_headers(send))


def is_loopback(host: str) -> bool:
    """Return whether an address to listen at is reached from this machine only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _cookie(header: str) -> str:
    match = re.search(rf"(?:^|;\s*){COOKIE}=([\w-]{{43}})(?:;|$)", header)
    return match[1] if match else ""


def _with_headers(send: Send) -> Send:
    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            message["headers"] = [*message.get("headers", ()), *_HEADERS]
        await send(message)

    return sending


def _login_page(problem: str, status: int = 200) -> HTMLResponse:
    alert = f'<p role="alert">{html.escape(problem)}</p>' if problem else ""
    return HTMLResponse(_LOGIN.replace("PROBLEM", alert), status)


_LOGIN = """<!doctype html><html lang="en"><head><meta charset="utf-8"><title>rtcp panel: log in</title>
<meta name="viewport" content="width=device-width, initial-scale=1"><style>
:root { color-scheme: light dark } body { font: 1.1rem system-ui, sans-serif; display: grid; min-height: 90vh;
place-items: center; margin: 0 } main { width: min(20rem, 90vw) } label { display: block; margin: 1rem 0 .3rem }
input, button { font: inherit; width: 100%; padding: .6rem; box-sizing: border-box } button { margin-top: 1.5rem }
[role=alert] { border-left: .3rem solid #b91c1c; padding-left: .6rem }</style></head><body><main>
<h1>rtcp panel</h1>PROBLEM<form method="post" action="/login">
<label for="name">Your name, as others see it</label>
<input id="name" name="name" maxlength="32" autocomplete="username" required autofocus>
<label for="password">Password</label>
<input id="password" name="password" type="password" autocomplete="current-password" required>
<button>Log in</button></form></main></body></html>"""


def passwords_for(host: str, file: Path) -> Path | None:
    """Return the password file that a panel at this address uses; None: no password is needed.

    Raises:
        Invalid: other machines reach the address and there is no password, or the file cannot be used.
    """
    if file.exists() and read_passwords(file):
        return file
    if not is_loopback(host):
        message = f"--host {host}: other machines reach it, and there is no password: `rtcp panel password` sets one"
        raise RtcpError("invalid", message)
    return None
