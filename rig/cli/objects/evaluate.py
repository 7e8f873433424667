"""`rig eval`."""

import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from hbr.evaluation.experiment import Experiment
from hbr.evaluation.photographs import Dataset, load_coil
from rig.catalog.describing import known_descriptor
from rig.catalog.jobs import JobProgress
from rig.cli.ui.command import command
from rig.cli.ui.options import JobsOption
from rig.cli.ui.present import ProgressBar, console
from rig.cli.ui.settings import Settings
from rig.core.errors import UsageError
from rig.evaluation.experiments import DEFAULT, load_catalog, load_experiment
from rig.evaluation.run import own_folder, run_experiment, write_results
from rig.evaluation.tables import contest_sentences, tables


@command
def evaluate(
    settings: Settings,
    experiment: Annotated[
        str,
        typer.Argument(
            help="Name of a shipped experiment (docs/results.md), a TOML file, or a folder of photographs for the "
            "experiment paper."
        ),
    ] = "paper",
    data: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Images obj{N}__{angle}.png or .jpg; the catalog by default.")
    ] = None,
    noise: Annotated[
        str | None, typer.Option(help="Noise of the queries: none, gn, gn:VARIANCE, mb, mb:PIXELS:DEGREES, gn+mb.")
    ] = None,
    methods: Annotated[
        str | None,
        typer.Option(
            help="Methods or groups, separated by commas: all (the paper), beyond (the dense filter and its "
            "baselines), omega-sweep, list-sweep."
        ),
    ] = None,
    descriptor: Annotated[
        str | None, typer.Option(metavar="NAME", help="Descriptor of the views: cedd, edges+colours+cedd, ...")
    ] = None,
    orientation_errors: Annotated[
        str | None,
        typer.Option(metavar="FILE", help="Errors of the orientation: a result imu.rotation of rig calibrate imu."),
    ] = None,
    jobs: JobsOption = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Folder for the results (default: one in rig-eval for these settings)."),
    ] = None,
) -> None:
    """Measure retrieval on a folder of photographs in the layout of COIL-100, or on the catalog.

    Example: rig eval paper --data coil-100 --noise mb
    """
    if data is None and Path(experiment).is_dir():
        experiment, data = DEFAULT, Path(experiment)
    # The experiment, with what the options replace.
    rule = settings.load().identify
    try:
        asked = load_experiment(
            experiment,
            noise=noise,
            methods=methods,
            descriptor=None if descriptor is None else known_descriptor(descriptor).name,
            orientation_errors=orientation_errors,
            seed=settings.seed,
        )
        asked = replace(asked, margin=rule.margin, min_views=rule.min_views)
        dataset = _dataset(settings, data, asked)
        note = f"{dataset.name}: {len(dataset.objects)} objects, {dataset.views} views"
        note += ", irregular steps" if dataset.missing is None else f", {dataset.missing} missing"
        print(f"{note}, {dataset.ignored} other images" if dataset.ignored else note, file=sys.stderr)
        folder = out or own_folder(asked, dataset)
        done = 0
        with ProgressBar("enrolling, searching") as progress:

            def advance(event: str, name: str) -> None:
                nonlocal done
                done += 1
                progress(JobProgress(done, 2 * len(dataset.objects)))
                if settings.json:
                    settings.print_json({"event": event, "object": name})

            results = run_experiment(asked, dataset, jobs or os.cpu_count() or 1, advance)
    except ValueError as error:
        raise UsageError(str(error), next_step="Correct the experiment, the options or the data set.") from error
    # The files first: they are the result, the tables below only show it.
    write_results(results, folder)
    if settings.json:
        settings.print_json({"event": "finished", **results})
        return
    screen = console()
    for table in tables(results):
        screen.print(table)
        screen.print()
    for sentence in contest_sentences(results):
        screen.print(sentence, markup=False, highlight=False, soft_wrap=not screen.is_terminal)
    print(f"Written: {folder}/results.json, results.csv, and the figures if there are any.", file=sys.stderr)


def _dataset(settings: Settings, folder: Path | None, experiment: Experiment) -> Dataset:
    if folder is None:
        with settings.open_catalog(read_only=True) as catalog:
            dataset = load_catalog(catalog)
    else:
        dataset = load_coil(folder)
    if experiment.objects is not None:
        dataset = dataset.subset(*experiment.objects)
    if experiment.report is not None:
        dataset.subset(*experiment.report)  # rejects objects that do not exist
    return dataset
