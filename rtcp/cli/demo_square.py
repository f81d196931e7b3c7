"""The square of `rtcp demo --square`: driven by straight lines, recorded, judged, drawn."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from rtcp.cli.errors import CommandError, ExitCode
from rtcp.cli.motion import SILENCE_S, arrival, move
from rtcp.cli.output import report

if TYPE_CHECKING:
    from rtcp.config.model import ArmConfig
    from rtcp.ipc.client import ControlClient
    from rtcp.telemetry.square import Driven, Square

ENDINGS = (".png", ".svg", ".pdf")


def prepare(config: ArmConfig, plane: str, picture: Path | None) -> SquareDrive:
    """Find where the arm can drive the square, and where its picture goes, before anything is started.

    Raises:
        CommandError: another plane, a picture that cannot be written, or no room for the square.
    """
    from rtcp.telemetry.square import PLANES, NoSquare, place

    if plane.lower() not in PLANES:
        raise CommandError(f"--square {plane} is not known: {', '.join(PLANES)}")
    out = Path(f"square-{plane.lower()}.png") if picture is None else picture
    if out.suffix.lower() not in ENDINGS:
        raise CommandError(f"--picture {out}: its ending must be one of {', '.join(ENDINGS)}")
    if not out.absolute().parent.is_dir():
        raise CommandError(f"--picture {out}: there is no folder {out.absolute().parent}")
    try:
        return SquareDrive(config, place(config, plane.lower()), out)
    except NoSquare as error:
        raise CommandError(str(error), ExitCode.REFUSED) from error


class SquareDrive:
    """Drives a square once and tells how it went.

    Args:
        config: the arm.
        square: where it is.
        out: the picture's file.
    """

    def __init__(self, config: ArmConfig, square: Square, out: Path) -> None:
        self._config = config
        self._square = square
        self._out = out
        self._driven: Driven | None = None

    def run(self, client: ControlClient) -> None:
        """Move to the first corner, then along the four sides, while every cycle is recorded.

        Raises:
            RtcpError: as the platform ended a motion.
            CommandError: nothing moved.
        """
        from rtcp.ipc.runtime_directory import blackboard_file, runtime_directory
        from rtcp.telemetry.recording import recording
        from rtcp.telemetry.square import SPEED_M_S, NoSquare, judge

        square, model = self._square, self._config.arm
        report(f"first corner: {arrival(move(client, square.start, None, _unseen))}")
        with recording(blackboard_file(runtime_directory())) as recorded:
            arguments = {"poses": square.poses, "speed": SPEED_M_S}
            result = client.call("line", arguments, _unseen, timeout_s=SILENCE_S)
        report(f"square in {square.plane}: {arrival(result)}")
        if model is None:
            raise CommandError("the arm has no geometry")
        try:
            self._driven = judge(model, square, recorded)
        except NoSquare as error:
            raise CommandError(str(error), ExitCode.FAULT) from error

    def tell(self) -> None:
        """Say how far the tool was from the square, and draw the picture."""
        from rtcp.telemetry.square import draw

        if self._driven is None:
            return
        commanded, actual = (1e3 * worst for worst in self._driven.worst)
        report(f"largest deviation from the square: {commanded:.3f} mm commanded, {actual:.2f} mm actual")
        if self._driven.lost:
            report(f"{self._driven.lost} cycle records were lost to the recording")
        try:
            draw(self._driven, self._out)
        except OSError as error:
            raise CommandError(f"the picture {self._out} cannot be written: {error.strerror}") from error
        report(f"picture: {self._out}")


def _unseen(progress: Any) -> None:
    """Take progress that a line a motion makes superfluous."""
