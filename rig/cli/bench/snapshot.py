"""`rig snapshot`."""

import sys
from contextlib import closing
from pathlib import Path
from typing import Annotated

import typer

from rig.cli.ui.command import command
from rig.cli.ui.options import check_new, write_new
from rig.cli.ui.settings import Settings
from rig.core.errors import UsageError
from rig.core.next_steps import Do
from rig.doctor.camera import open_camera
from rig.views.image_files import encode


@command
def snapshot(
    settings: Settings,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="PNG file to write. It must not exist.")],
    refocus: Annotated[
        bool,
        typer.Option(
            "--refocus", help="Let the autofocus find a new position, and store it. Use it after you moved the camera."
        ),
    ] = False,
) -> None:
    """Take an image with the camera and its locked settings, and write it to a file. Moves nothing.

    Example: rig snapshot table.png --bench sim
    """
    check_new(file, ".png")
    if refocus and settings.load().camera.focus is not None:
        raise UsageError(
            "camera.focus is a number.", next_step=("Release it first.", Do.SET_KEY(key="camera.focus", value="none"))
        )
    with settings.open_parts() as context:
        context.require_free()
        with closing(open_camera(context, refocus=refocus)) as camera:
            frame = camera.capture(context.computer.clock.now_ns())
            identity, locks = camera.identity, camera.read_locks()
    write_new(file, encode(frame.image_bgr))
    size = f"{identity.width}x{identity.height}"
    report = {"file": str(file), "camera": identity, "locks": locks}
    settings.say(f"{file}: {size} pixels, mean level {frame.image_bgr.mean():.0f}.", report)
    if refocus:
        focus = "The camera reports no focus" if locks.focus is None else f"The focus is {locks.focus:g} now"
        print(f"{focus}.", file=sys.stderr)
