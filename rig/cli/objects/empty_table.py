"""`rig empty-table`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.ui.command import command
from rig.cli.ui.settings import Settings
from rig.core.errors import UsageError, os_errors_as
from rig.core.files import write
from rig.core.next_steps import Do

if TYPE_CHECKING:
    from rig.bench import Bench


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
    little to check that it is empty. If the check fails, the previous image stays in use.

    Example: rig empty-table --bench sim

    Example: rig empty-table --show empty.png
    """
    from rig.cli.ui.desk import CommandDesk
    from rig.jobs.table_image import take_table_image

    if show is not None and anyway:
        raise UsageError("--show takes no image, so --anyway has no effect.", next_step="Remove --anyway.")
    if show is None:
        desk = CommandDesk(settings)
        desk.run(take_table_image(desk, anyway=anyway))
        return
    with settings.open_bench() as bench:
        _show(settings, bench, show)


def _show(settings: Settings, bench: "Bench", path: Path) -> None:
    from rig.views import image_files as images
    from rig.views.empty_table import empty_table_status

    status = empty_table_status(bench)
    if status.table is None:
        raise UsageError(f"There is no image to show: {status.text}.", next_step=Do.EMPTY_TABLE())
    with os_errors_as(UsageError, f"{path} cannot be written.", next_step="Choose another file with --show."):
        write(path, images.encode(status.table.image_bgr))
    settings.say(f"{path}: {status.text}", {"file": str(path), **status.as_json()})
