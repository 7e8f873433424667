"""Shell completion of names; it offers nothing if something is wrong."""

import os
from contextlib import closing, suppress
from importlib.metadata import entry_points

import typer


def object_names(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return the names of the enrolled objects that begin with ``incomplete``."""
    import sqlite3

    from rig.cli.ui.settings import Settings
    from rig.config.catalog_place import DATABASE_NAME

    # An unfinished command line can hold anything, such as an unknown bench or a file that is not a configuration.
    with suppress(Exception):
        given = {**(ctx.parent.params if ctx.parent else {}), **ctx.params}
        options = {name: given[name] for name in ("bench", "config", "overrides") if name in given}
        settings = Settings().merged(**options)
        place = settings.place
        # A server may take long to answer, so its names are those of the last search on this computer.
        path = place.database_file if place.url is None else place.copy_folder / DATABASE_NAME
        # sqlite3 directly: importing SQLAlchemy, and with it the check of the folder, takes too long for completion.
        if os.path.lexists(f"{path}-journal"):
            return []
        with closing(sqlite3.connect(f"{path.as_uri()}?mode=ro", uri=True, timeout=0.2)) as database:
            rows = database.execute(
                "SELECT object_name FROM log AS named WHERE deleted = 0 AND substr(object_name, 1, ?) = ? "
                "AND NOT EXISTS (SELECT 1 FROM log AS later WHERE later.object_id = named.object_id "
                "AND later.deleted IS NOT NULL AND later.id > named.id) ORDER BY object_name",
                (len(incomplete), incomplete),
            )
            return [str(name) for (name,) in rows]
    return []


def bench_names(incomplete: str) -> list[str]:
    """Return the names of the installed benches."""
    return sorted(point.name for point in entry_points(group="rig.benches") if point.name.startswith(incomplete))


def config_keys(incomplete: str) -> list[str]:
    """Return the keys of the configuration, and those of the installed benches."""
    from rig.bench import bench_kind
    from rig.config import RigConfig
    from rig.config.wording import key_info

    keys = [info.name for info in key_info(RigConfig) if info.name != "bench"]
    for name in bench_names(""):
        with suppress(Exception):  # a plug-in that cannot be loaded
            keys += [info.name for info in key_info(bench_kind(name).options, ("bench", name))]
    return [key for key in keys if key.startswith(incomplete)]


def strategy_names(incomplete: str) -> list[str]:
    """Return the names of the search strategies."""
    names = ["dense", "arc", "ahbr", "hbr", "sweep", "random", "hmm"]
    return [name for name in names if name.startswith(incomplete)]
