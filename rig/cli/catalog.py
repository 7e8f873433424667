"""`rig catalog ...`."""

from typing import Annotated

import typer

from rig.cli.command import Settings, command

app = typer.Typer(help="Look at the enrolled objects.", no_args_is_help=True)


@app.command("list")
@command
def list_(settings: Settings) -> None:
    """List the enrolled objects.

    Example: rig catalog list --bench sim
    """
    from rig.plans.events import plain

    with settings.open_catalog(read_only=True) as catalog:
        objects = catalog.objects()
        if settings.json:
            settings.print_json({"catalog": str(catalog.path), "objects": plain(objects)})
            return
    if not objects:
        print("No objects yet: rig enroll NAME.")
        return
    from rich.console import Console
    from rich.table import Table

    table = Table("object", "label", "views", "enrolled (UTC)", box=None, pad_edge=False)
    for item in objects:
        views = str(item.views)
        if item.unfinished_views is not None:
            views += f" (+{item.unfinished_views} unfinished)"
        enrolled = f"{item.enrolled_utc:%Y-%m-%d %H:%M}" if item.enrolled_utc else "not yet"
        table.add_row(item.name, item.label, views, enrolled)
    Console().print(table)


@app.command("show")
@command
def show(settings: Settings, name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the object.")]) -> None:
    """Show an object: its enrollments, and the angles and evidence of its views.

    Example: rig catalog show mug-white --bench sim
    """
    from rig.plans.events import plain

    with settings.open_catalog(read_only=True) as catalog:
        details = catalog.object(name)
        if settings.json:
            settings.print_json(plain(details))
            return
        folder = catalog.path
    summary = details.summary
    print(f"{summary.name}  {summary.label}\n{summary.note}".rstrip())
    for enrollment in details.enrollments:
        print(
            f"enrollment {enrollment.id}: {enrollment.status}, {len(enrollment.present)} of "
            f"{len(enrollment.planned_azimuth_deg)} views, begun {enrollment.started_utc:%Y-%m-%d %H:%M} UTC"
        )
    if details.views:
        print(f"images in {(folder / details.views[0].image).parent}")
        print("view  azimuth  encoder      IMU   sharpness")
    for view in details.views:
        record = view.record
        imu = "     –" if record.imu_deg is None else f"{record.imu_deg:8.2f}"
        print(
            f"{record.index:4d}  {record.azimuth_deg:6.2f}°  {record.encoder_deg:7.2f}  {imu}  "
            f"{record.evidence.get('sharpness', float('nan')):8.1f}"
        )
