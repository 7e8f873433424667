"""The option ``--cluster`` of long jobs."""

from typing import TYPE_CHECKING, Annotated

import typer

from rig.core.errors import UsageError

if TYPE_CHECKING:
    from rig.core.processes import Jobs

ClusterOption = Annotated[
    str | None,
    typer.Option(
        "--cluster",
        metavar="ADDRESS",
        help="Work on a Dask cluster: the address of its scheduler, or local, or local:WORKERS.",
    ),
]


def jobs_of(jobs: int | None, cluster: str | None) -> "Jobs | None":
    """Return where the work is done.

    Raises
    ------
    UsageError
        Both are given.
    """
    from rig.core.cluster import Cluster

    if cluster is None:
        return jobs
    if jobs is not None:
        raise UsageError("--jobs and --cluster are both given.", next_step="Give one of them; local:2 has 2 workers.")
    return Cluster(cluster)
