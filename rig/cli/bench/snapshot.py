"""`rig snapshot` and `rig empty-table`."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.bench.doctor import check_new, take, write_new
from rig.cli.ui.command import command
from rig.cli.ui.settings import Settings
from rig.core.errors import UsageError, os_errors_as
from rig.core.files import write
from rig.core.next_steps import Do

if TYPE_CHECKING:
    pass


@command
def snapshot(
    settings: Settings,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="PNG file to write. It must not exist.")],
    refocus: Annotated[
        bool,
        typer.Option(
            "--refocus",
            help="Let the autofocus find a new position, and store it. Use it after you moved the camera.",
        ),
    ] = False,
) -> None:
    """Take an image with the camera and its locked settings, and write it to a file. Moves nothing.

    Example: rig snapshot table.png --bench sim
    """
    from rig.views.image_files import encode

    check_new(file, ".png")
    if refocus and settings.load().camera.focus is not None:
        raise UsageError(
            "camera.focus is a number.", next_step=("Release it first.", Do.SET_KEY(key="camera.focus", value="none"))
        )
    frame, identity, locks = take(settings, refocus=refocus)
    write_new(file, encode(frame.image_bgr))
    size = f"{identity.width}x{identity.height}"
    report = {"file": str(file), "camera": identity, "locks": locks}
    settings.say(f"{file}: {size} pixels, mean level {frame.image_bgr.mean():.0f}.", report)
    if refocus:
        focus = "The camera reports no focus" if locks.focus is None else f"The focus is {locks.focus:g} now"
        print(f"{focus}.", file=sys.stderr)


@command
def empty_table(
    settings: Settings,
    show: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Only write the stored image to a PNG file.")
    ] = None,
    anyway: Annotated[
        bool,
        typer.Option("--anyway", help="Store the image although something on the table rotates: a pattern or a screw."),
    ] = False,
) -> None:
    """Take an image of the empty table. Do this once a day, and when the light has changed.

    Objects are found by comparing views with this image. First take everything off the table. The table rotates a
    little to check that it is empty. If the check fails, the previous image stays in use. A camera that moves around
    the object takes an image at each azimuth of enroll.views; no check then finds a forgotten object.

    Example: rig empty-table --bench sim

    Example: rig empty-table --show empty.png
    """
    from rig.cli.ui.desk import CommandDesk
    from rig.jobs.table_image import take_table_image
    from rig.views.empty_table import empty_table_status
    from rig.views.image_files import encode

    if show is not None and anyway:
        raise UsageError("--show takes no image, so --anyway has no effect.", next_step="Remove --anyway.")
    if show is None:
        desk = CommandDesk(settings)
        desk.run(take_table_image(desk, anyway=anyway))
        return
    with settings.open_bench() as bench:
        status = empty_table_status(bench)
    if status.table is None:
        raise UsageError(f"There is no image to show: {status.text}.", next_step=Do.EMPTY_TABLE())
    with os_errors_as(UsageError, f"{show} cannot be written.", next_step="Choose another file with --show."):
        write(show, encode(status.table.image_bgr))
    settings.say(f"{show}: {status.text}", {"file": str(show), **status.as_json()})
