"""Recorder: on and off, its files to download and plot. Programs: motion files, checked and run."""

from __future__ import annotations

from datetime import datetime
from functools import partial
from pathlib import Path
from urllib.parse import quote

from nicegui import ui

from rtcp.api import Progress, RtcpError
from rtcp.config.zero import state_directory
from rtcp.panel.page import View, button, choice, field, on_click, row, table, text

_FORMATS = ("mcap", "csv", "mcap,csv")
_ENDINGS = (".mcap", ".csv")
_MOST_SHOWN = 30


def recordings_directory() -> Path:
    """Return the directory in which the panel records, and from which it offers files."""
    return state_directory() / "recordings"


def build(view: View) -> None:
    """Build the page."""
    text("h1", "Recorder")
    with ui.element("div").classes("fields"):
        name = field("File name", placeholder="by the time")
        formats = choice("Format", _FORMATS, "mcap")
        signals = field("Signals", placeholder="all")
    with ui.element("div").classes("buttons"):
        begin = button("Record")
        end = button("Stop recording", plain=True)
        end.props["disabled"] = True
        again = button("Show the files", plain=True)
    notice = text("p", "", role="status")
    files = ui.element("div").classes("page")

    async def start() -> None:
        # It moves nothing and needs no lease: also while something moves.
        if not view.may_command():
            return
        directory = recordings_directory()
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        wanted = Path(name.value.strip()).name.lstrip(".") or f"{datetime.now():%Y-%m-%d_%H-%M-%S}"
        endings = formats.value.split(",")
        # One format: a file of that name; several: a folder.
        out = directory / (f"{wanted}.{endings[0]}" if len(endings) == 1 else wanted)
        chosen = signals.value.replace(",", " ").split()
        if await view.ask(lambda robot: robot.record_start(out, formats=endings, signals=chosen)) is not None:
            await refresh()

    async def stop() -> None:
        if not view.may_command():
            return
        ended = await view.ask(lambda robot: robot.record_stop())
        for recording in ended or ():
            view.say(f"{recording.records} cycles, {recording.missing} missing, {recording.bytes / 1e6:.1f} MB")
        await refresh()

    async def refresh() -> None:
        try:
            running = [entry for entry in await view.query(lambda robot: robot.record_status()) if entry.running]
        except RtcpError as error:
            running = []
            notice.text = error.message
        else:
            lines = []
            for entry in running:
                names = ", ".join(Path(file).name for file in entry.files)
                lines.append(f"{names}: {entry.records} samples, {entry.missing} missing, {entry.seconds:.0f} s")
            notice.text = "; ".join(lines) or "Nothing is recorded"
        end.props["disabled"] = not running

    def show_files() -> None:
        files.clear()
        with files:
            body = table(("File", "MB", "", ""), "Recordings")
        paths = sorted(_files(), key=lambda path: path.stat().st_mtime, reverse=True)[:_MOST_SHOWN]
        for path in paths:
            where = str(path.relative_to(recordings_directory()))
            with row(body, where, f"{path.stat().st_size / 1e6:.1f}"):
                with ui.element("td"):
                    link = text("a", "Download", href=f"/recordings/{quote(where)}")
                    link.props.update({"download": path.name, "aria-label": f"Download {where}"})
                with ui.element("td"):
                    button("Plot", partial(plot, path), plain=True).props["aria-label"] = f"Plot {where}"

    async def plot(path: Path) -> None:
        picture = path.with_suffix(".png")
        code, out = await view.rtcp("plot", str(path), "--out", str(picture))
        if code:
            view.warn(out)
            return
        with files, ui.element("figure"):
            where = picture.relative_to(recordings_directory())
            image = ui.element("img").style("max-width: 100%; background: #fff")
            image.props.update(
                {"src": f"/recordings/{quote(str(where))}?{picture.stat().st_mtime_ns}", "alt": f"Plot of {path.name}"}
            )

    on_click(begin, start)
    on_click(end, stop)
    on_click(again, show_files)
    ui.timer(1.0, refresh)
    _programs(view)


def _files() -> list[Path]:
    directory = recordings_directory()
    return (
        [path for path in directory.rglob("*") if path.suffix in _ENDINGS and path.is_file()]
        if directory.is_dir()
        else []
    )


def _programs(view: View) -> None:
    text("h2", "Run a motion file")
    with ui.element("div").classes("fields"):
        file = field("Motion file", list="programs", placeholder="path of a file")
        approach = choice("Start", {"approach": "move to its beginning first", "": "the arm stands there"}, "approach")
    with ui.element("datalist").props("id=programs"):
        for path in sorted(_motion_files()):
            ui.element("option").props["value"] = str(path)
    notice = text("p", "", role="status", **{"aria-live": "polite"})
    bar = ui.element("progress").props("max=1 value=0 aria-label=Progress")

    async def check() -> bool:
        if not view.may_command():
            return False
        path, first = file.value.strip(), bool(approach.value)
        try:
            preview = await view.query(lambda robot: robot.preview(file=path, approach=first))
        except RtcpError as error:
            notice.text = f"No: {error.message}"
            return False
        notice.text = f"It can be run: {preview.duration_s:.1f} s"
        if view.arm is not None:
            view.arm.preview([list(q) for q in preview.path], preview.duration_s)
        return True

    def progress(now: Progress) -> None:
        if bar.is_deleted:
            return  # the page was left; the program goes on
        bar.props["value"] = round(now.fraction, 3)
        notice.text = f"{now.fraction:.0%}, {now.remaining_s:.1f} s left"

    async def run() -> None:
        if await check():
            path, first = file.value.strip(), bool(approach.value)
            arrival = await view.act(lambda robot: robot.run(path, first, progress))
            bar.props["value"] = 1 if arrival else 0
            notice.text = "Done" if arrival else "It has not reached its end"

    with ui.element("div").classes("buttons"):
        button("Check", check, plain=True)
        button("Run", run, when="holding")
        button("Stop the program", view.halt, when="moving", plain=True)


def _motion_files() -> list[Path]:
    directory = state_directory() / "programs"
    return [path for path in directory.glob("*") if path.suffix in (".yaml", ".yml", ".csv")]
