"""The gateway: the control socket, and the picture of the platform that it serves.

It may die and be started again while the loop holds the arm still: a motion that it was carrying ends with its lease.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import logging
import os
import signal
import struct
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

from rtcp.runtime.commander import Commander, CommandFailed
from rtcp.runtime.observer import BlackboardError, Observer
from rtcp.runtime.paths import blackboard_file, control_socket, processes_file, stopping_mark
from rtcp.runtime.picture import Picture
from rtcp.runtime.session import end, read_processes, read_session, wait_gone

_FOLLOW_S = 0.02
_LINE_LIMIT = 1 << 16
log = logging.getLogger("rtcp.gateway")


class Gateway:
    """Serves one running platform.

    Args:
        directory: the runtime directory.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        session = read_session(directory / "session.pickle")
        self._observer = Observer(blackboard_file(directory))
        started = json.loads((directory / "started.json").read_text())
        self._picture = Picture(self._observer, session, started)
        self._commander = Commander(self._observer, self._picture, session.config)
        self._ended = asyncio.Event()
        self._stopping = False
        self._following: asyncio.Task[None] | None = None
        self._verbs: dict[str, Callable[[str, dict[str, Any], Any], Awaitable[dict[str, Any]]]] = {
            "status": self._status,
            "enable": lambda client, args, tell: self._commander.enable(client),
            "disable": lambda client, args, tell: self._commander.disable(client),
            "reset": lambda client, args, tell: self._commander.reset(client),
            "mode": lambda client, args, tell: self._commander.mode(client, str(args["name"])),
            "move": self._move,
            "halt": lambda client, args, tell: self._commander.halt(client),
            "output": self._output,
            "scan": self._scan,
            "sdo_read": self._sdo,
            "sdo_write": lambda client, args, tell: self._commander.sdo_write(client, args),
            "stop": self._stop,
        }

    async def serve(self, ready: Callable[[], None]) -> None:
        """Serve until the platform is stopped or SIGTERM comes; call `ready` when the socket listens."""
        path = control_socket(self._directory)
        path.unlink(missing_ok=True)
        before = os.umask(0o177)
        try:
            server = await asyncio.start_unix_server(self._client, path, limit=_LINE_LIMIT)
        finally:
            os.umask(before)
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, self._ended.set)
        self._watch_loop(loop)
        self._following = asyncio.create_task(self._follow())
        ready()
        await self._ended.wait()
        # Not waiting for clients that are still there (`status --watch`): they learn it by the closed connection.
        server.close()
        self._following.cancel()
        path.unlink(missing_ok=True)

    def _watch_loop(self, loop: asyncio.AbstractEventLoop) -> None:
        try:
            descriptor = os.pidfd_open(self._observer.loop_pid)
        except OSError:
            self._picture.loop_lives = False
            return

        def gone() -> None:
            loop.remove_reader(descriptor)
            os.close(descriptor)
            self._picture.loop_lives = False
            log.error("the loop (process %d) has ended", self._observer.loop_pid)

        loop.add_reader(descriptor, gone)

    async def _follow(self) -> None:
        while True:
            for sentence in self._picture.follow():
                log.info("%s", sentence)
            await asyncio.sleep(_FOLLOW_S)

    # -- clients ------------------------------------------------------------------------------------------------

    async def _client(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(ConnectionError, asyncio.CancelledError):
            await self._converse(reader, writer)
        with contextlib.suppress(ConnectionError):
            writer.close()

    async def _converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        line = asyncio.ensure_future(_read_line(reader))
        while True:
            given = await line
            if given is None:
                return
            line = asyncio.ensure_future(_read_line(reader))
            work = asyncio.ensure_future(self._answer(given, writer))
            # A client that goes away ends what it asked for: its lease goes with it.
            await asyncio.wait({line, work}, return_when=asyncio.FIRST_COMPLETED)
            if not work.done() and line.done() and line.result() is None:
                work.cancel()
                with contextlib.suppress(asyncio.CancelledError):
                    await work
                return
            await work

    async def _answer(self, given: bytes, writer: asyncio.StreamWriter) -> None:
        number: Any = None
        try:
            request = _parse(given)
            number = request.get("id")

            async def tell(progress: dict[str, Any]) -> None:
                await _send(writer, {"id": number, "progress": progress})

            verb = self._verbs.get(str(request.get("do")))
            if verb is None:
                raise CommandFailed("invalid", f"{request.get('do')!r} is unknown: one of {', '.join(self._verbs)}")
            args = request.get("args") or {}
            if not isinstance(args, dict):
                raise CommandFailed("invalid", f"args must be an object, not {type(args).__name__}")
            args = {**args, "do": request["do"]}
            result = await verb(str(request.get("client") or "an unnamed client"), args, tell)
            await _send(writer, {"id": number, "ok": True, "result": result})
        except CommandFailed as failed:
            await _send(writer, {"id": number, "ok": False, "error": {"kind": failed.kind, "message": str(failed)}})
        except (KeyError, TypeError, ValueError, OverflowError, struct.error, BlackboardError) as error:
            sentence = f"the request's arguments are not of the verb's form: {type(error).__name__} {error}"
            await _send(writer, {"id": number, "ok": False, "error": {"kind": "invalid", "message": sentence}})
        except ConnectionError:
            raise
        except Exception as error:
            # One request's defect is answered and logged; the others are served on.
            log.exception("request %.200r", given)
            sentence = f"the gateway met a defect: {type(error).__name__} {error}"
            await _send(writer, {"id": number, "ok": False, "error": {"kind": "internal", "message": sentence}})
        if self._stopping:
            self._ended.set()

    # -- verbs --------------------------------------------------------------------------------------------------

    async def _status(self, client: str, args: dict[str, Any], tell: Any) -> dict[str, Any]:
        self._picture.follow()
        return self._picture.status(read_processes(self._directory))

    async def _move(self, client: str, args: dict[str, Any], tell: Any) -> dict[str, Any]:
        speed = args.get("speed")
        q = [float(value) for value in args["q"]]
        return await self._commander.move(client, q, None if speed is None else float(speed), tell)

    async def _output(self, client: str, args: dict[str, Any], tell: Any) -> dict[str, Any]:
        return await self._commander.output(client, int(args["number"]), bool(args["value"]))

    async def _scan(self, client: str, args: dict[str, Any], tell: Any) -> dict[str, Any]:
        slaves = json.loads((self._directory / "scan.json").read_text())
        states = self._picture.status(read_processes(self._directory))["slaves"]
        for slave, now in zip(slaves, states, strict=False):
            slave["state"] = now["state"]
        return {"slaves": slaves}

    async def _sdo(self, client: str, args: dict[str, Any], tell: Any) -> dict[str, Any]:
        return await self._commander.service(args)

    async def _stop(self, client: str, args: dict[str, Any], tell: Any) -> dict[str, Any]:
        processes = read_processes(self._directory)
        stopping_mark(self._directory).touch(mode=0o600)
        if self._picture.loop_lives:
            with contextlib.suppress(BlackboardError):
                await self._commander.shut_down()
            # The blocking waits run beside, so that this process goes on answering `status`.
            if not await asyncio.to_thread(wait_gone, processes.loop, 6.0):
                await asyncio.to_thread(end, processes.loop, 4.0)
        await asyncio.to_thread(end, processes.segment, 3.0)
        if self._following is not None:
            self._following.cancel()
        blackboard_file(self._directory).unlink(missing_ok=True)
        processes_file(self._directory).unlink(missing_ok=True)
        self._stopping = True
        return {}


async def _read_line(reader: asyncio.StreamReader) -> bytes | None:
    try:
        line = await reader.readline()
    except (ValueError, ConnectionError):
        # A line beyond the limit: nothing that follows can be trusted.
        return None
    return line or None


def _parse(given: bytes) -> dict[str, Any]:
    try:
        request = json.loads(given)
    except (ValueError, RecursionError) as error:
        raise CommandFailed("invalid", f"the request is no JSON: {error}") from None
    if not isinstance(request, dict):
        raise CommandFailed("invalid", f"the request must be an object, not {type(request).__name__}")
    return request


async def _send(writer: asyncio.StreamWriter, answer: dict[str, Any]) -> None:
    writer.write(json.dumps(answer).encode() + b"\n")
    await writer.drain()


def main() -> int:
    """Run the gateway's process."""
    parser = argparse.ArgumentParser(prog="rtcp.runtime.gateway")
    parser.add_argument("--directory", type=Path, required=True)
    parser.add_argument("--ready-fd", type=int, required=True)
    given = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", stream=sys.stderr)

    def ready() -> None:
        with contextlib.suppress(OSError):
            os.write(given.ready_fd, json.dumps({"event": "ready", "pid": os.getpid()}).encode() + b"\n")
            os.close(given.ready_fd)

    try:
        asyncio.run(_run(given.directory, ready))
    except (BlackboardError, OSError, TypeError) as error:
        sys.stderr.write(f"gateway: {error}\n")
        return 1
    return 0


async def _run(directory: Path, ready: Callable[[], None]) -> None:
    await Gateway(directory).serve(ready)


if __name__ == "__main__":
    sys.exit(main())
