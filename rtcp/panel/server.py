"""The panel's process: its pages, its sockets and files over HTTP, and the order in which they begin and end."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import secrets
import socket
import threading
import webbrowser
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from pathlib import Path

import uvicorn
from fastapi import FastAPI, HTTPException, Request, Response, WebSocket
from nicegui import Client, app, ui
from starlette.responses import FileResponse
from starlette.staticfiles import StaticFiles

from rtcp.api import RtcpError
from rtcp.config.zero import state_directory
from rtcp.panel.access import Access, Listener, Sessions, Visitor, password_file, passwords_for
from rtcp.panel.frame import Frame, Tab
from rtcp.panel.live import Live
from rtcp.panel.metrics import exposition
from rtcp.panel.page import View
from rtcp.panel.pages import (
    alarms,
    arm,
    cell,
    health,
    io,
    jog,
    limits,
    processes,
    program,
    recorder,
    scope,
    segment,
    start,
    targets,
)

_STATIC = Path(__file__).parent / "static"
_LOOK_AFTER_S = 0.5
PAGES: dict[str, Tab] = {
    "/": Tab("Start", start.build),
    "/jog": Tab("Jog", jog.build),
    "/program": Tab("Program", program.build),
    "/targets": Tab("Targets", targets.build),
    "/arm": Tab("Arm", arm.build),
    "/io": Tab("I/O", io.build),
    "/scope": Tab("Scope", scope.build),
    "/recorder": Tab("Recorder", recorder.build),
    "/segment": Tab("Segment", segment.build),
    "/limits": Tab("Limits", limits.build),
    "/health": Tab("Health", health.build),
    "/alarms": Tab("Alarms", alarms.build),
    "/cell": Tab("Cell", cell.build),
    "/processes": Tab("Processes", processes.build),
}
"""Path -> tab. Cell is shown where the arm is in one, and Processes where the platform has one."""
_COLOURS = {"primary": "#1864ab", "positive": "#237032", "negative": "#c92a2a", "warning": "#9c4a00", "info": "#0b7285"}


@dataclass(frozen=True)
class PanelOptions:
    """Options of `rtcp panel`."""

    host: str = "127.0.0.1"
    port: int = 8080
    open: bool = False
    certificate: Path | None = None
    key: Path | None = None


class Panel:
    """Serves the pages.

    Args:
        options: where and how.

    Raises:
        Invalid: other machines reach the address and there is no password.
        Refused: nothing can listen there.
    """

    def __init__(self, options: PanelOptions) -> None:
        self._sessions = Sessions(passwords_for(options.host, password_file()))
        self._live = Live(lambda secret: self._sessions.find(secret) is not None)
        self._options = options
        family = socket.AF_INET6 if ":" in options.host else socket.AF_INET
        self._socket = Listener(family)
        try:
            self._socket.bind((options.host, options.port))
            self._socket.listen()  # a client that is quicker than the start waits
        except OSError as error:
            self._socket.close()
            problem = f"{options.host} port {options.port} cannot be listened at: {error.strerror or error}"
            raise RtcpError("refused", f"{problem}: choose another by --port") from error
        host = f"[{options.host}]" if ":" in options.host else options.host
        scheme = "http" if options.certificate is None else "https"
        self.url = f"{scheme}://{host}:{self._socket.getsockname()[1]}/"

    def run(self) -> None:
        """Serve until SIGINT or SIGTERM."""
        server = FastAPI(lifespan=self._lifespan, docs_url=None, redoc_url=None, openapi_url=None)
        server.add_middleware(
            Access,
            sessions=self._sessions,
            host=self._options.host,
            secure=self._options.certificate is not None,
            admit=self._socket.admit,
        )
        self._add_routes(server)
        for path in PAGES:
            ui.page(path, title="rtcp panel")(self._page)
        ui.run_with(server, title="rtcp panel", dark=None, language="en-US", tailwind=False, show_welcome_message=False,
                    binding_refresh_interval=None, reconnect_timeout=3.0)  # fmt: skip
        app.config.socket_io_js_transports = ["websocket"]
        options = self._options
        config = uvicorn.Config(
            server, log_level="warning", ws_max_size=1 << 16, access_log=False, server_header=False,
            ssl_certfile=options.certificate, ssl_keyfile=options.key, timeout_graceful_shutdown=1,
            proxy_headers=False, loop="asyncio",  # which accepts by the method of the listener
        )  # fmt: skip
        uvicorn.Server(config).run(sockets=[self._socket])

    @contextlib.asynccontextmanager
    async def _lifespan(self, server: FastAPI) -> AsyncIterator[None]:
        tasks = [asyncio.create_task(work) for work in (self._live.follow(), self._live.watch(), self._look_after())]
        if self._options.open:
            # Not in the event loop: for a text browser `webbrowser.open` waits until it ends.
            opening = threading.Timer(0.5, webbrowser.open, (self.url,))
            opening.daemon = True
            opening.start()
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            if self._live.operator is not None:
                await self._live.operator.end()

    async def _look_after(self) -> None:
        while True:
            self._socket.look_after()
            await asyncio.sleep(_LOOK_AFTER_S)

    def _add_routes(self, server: FastAPI) -> None:
        server.mount("/static", StaticFiles(directory=_STATIC))

        @server.websocket("/live")
        async def live(socket: WebSocket) -> None:
            await self._live.serve(socket, socket.scope["visitor"])

        @server.post("/stop")
        async def stop(request: Request) -> Response:
            problem = await self._live.halt()
            return Response(problem, 503) if problem else Response(status_code=204)

        @server.get("/metrics")
        async def metrics() -> Response:
            return Response(exposition(self._live), media_type="text/plain; version=0.0.4")

        @server.get("/recordings/{path:path}")
        async def recording(path: str) -> Response:
            return _file(recorder.recordings_directory(), path, ("mcap", "csv", "png"))

        @server.get("/faults/{path:path}")
        async def fault(path: str) -> Response:
            return _file(state_directory() / "faults", path, ("png",))

    def _page(self, request: Request, client: Client) -> None:
        visitor: Visitor = request.scope["visitor"]
        try:
            page = self._live.open(secrets.token_urlsafe(16), visitor, request.scope["secret"])
        except RtcpError as error:
            raise HTTPException(429, error.message) from error
        view = View(self._live, page, client)
        client.on_delete(lambda: self._close(view))
        ui.colors(**_COLOURS)
        ui.add_head_html('<link rel="stylesheet" href="/static/panel.css"><script src="/static/panel.js"></script>')
        Frame(view, PAGES, self._sessions.asks)

    async def _close(self, view: View) -> None:
        view.leave()
        await self._live.close(view.page)


def _file(directory: Path, path: str, endings: tuple[str, ...]) -> Response:
    """Return a file of a directory; 404 for a file outside of it, or of another kind."""
    try:
        target = (directory / path).resolve()
        is_ours = target.is_relative_to(directory.resolve()) and target.suffix[1:] in endings and target.is_file()
    except (OSError, ValueError):
        is_ours = False  # too long, or with a NUL
    if not is_ours:
        return Response("no such file", 404)
    return FileResponse(target)


def serve(options: PanelOptions, announce: Callable[[str], None]) -> None:
    """Serve the panel until it is ended; call `announce` with its address. Raises RtcpError."""
    logging.getLogger("nicegui").setLevel(logging.WARNING)
    panel = Panel(options)
    announce(panel.url)
    panel.run()
