"""`rig eval`."""

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.cli.ui.command import command
from rig.cli.ui.exit_codes import EXIT_INTERRUPTED
from rig.cli.ui.options import ClusterOption, JobsOption, descriptor_name, jobs_of
from rig.cli.ui.settings import Settings
from rig.core.errors import UsageError

if TYPE_CHECKING:
    from hbr.evaluation.datasets import Dataset
    from rig.core.processes import Jobs
    from rig.evaluation.plan import Plan
    from rig.evaluation.report import Rows

#: Draws of left-out objects.
_DRAWS = 5
_BOTH = "enrolling, searching"


@command
def evaluate(
    settings: Settings,
    folder: Annotated[
        Path | None,
        typer.Argument(metavar="[FOLDER]", help="Images obj{N}__{angle}.png or .jpg; the catalog by default."),
    ] = None,
    noise: Annotated[
        str, typer.Option(help="Noise of the queries: none, gn, gn:VARIANCE, mb, mb:PIXELS:DEGREES, gn+mb.")
    ] = "none",
    methods: Annotated[
        str | None,
        typer.Option(
            help="Methods or groups, separated by commas: all (the paper), beyond (the dense filter "
            "and its baselines), omega-sweep, list-sweep. all for CEDD, beyond for other descriptors."
        ),
    ] = None,
    descriptor: Annotated[
        str,
        typer.Option(
            metavar="NAME", help="Descriptor of the views: cedd, edges+colours; see docs/explanation/descriptors.md"
        ),
    ] = "cedd",
    perturb: Annotated[
        str, typer.Option(help="Other changes of the queries, as KIND:STRENGTH joined by +: shift:2+gain:1, all:3.")
    ] = "none",
    enrolled: Annotated[
        int | None,
        typer.Option(min=1, metavar="VIEWS", help="Enroll this number of views of each object, and query the others."),
    ] = None,
    trials: Annotated[int, typer.Option(min=1, help="Number of trials for each object.")] = 10,
    views: Annotated[int, typer.Option(min=1, help="Number of queries in a trial.")] = 8,
    removal: Annotated[
        str | None,
        typer.Option(
            help="Views taken out of the model: near (closer than 10° to a query), paper79, queries. near; queries "
            "with --enrolled."
        ),
    ] = None,
    size: Annotated[int | None, typer.Option(min=2, metavar="PIXELS", help="Longer side of all images.")] = None,
    orientation_noise: Annotated[
        float, typer.Option(min=0, metavar="DEGREES", help="Standard deviation of each measured orientation.")
    ] = 2.0,
    drift: Annotated[
        float, typer.Option(metavar="DEGREES", help="Drift of the measured orientation with each view.")
    ] = 0.0,
    rotate: Annotated[
        float,
        typer.Option(min=0, max=180, metavar="DEGREES", help="Rotate queries in the image plane, by up to this angle."),
    ] = 0.0,
    background: Annotated[
        str, typer.Option(help="Background of queries: same, uniform, textured; bench, other-bench (drawn benches).")
    ] = "same",
    reference: Annotated[
        str,
        typer.Option(
            help="Empty-table image for queries on a bench: own, enrollment (of the bench of the enrollment), none "
            "(not for enrolled views either)."
        ),
    ] = "own",
    enrolled_noise: Annotated[
        str, typer.Option(metavar="NOISE", help="Describe enrolled views under noise, too; values as for --noise.")
    ] = "none",
    prefilter: Annotated[
        float, typer.Option(min=0, metavar="PIXELS", help="Blur all images by a Gaussian of this standard deviation.")
    ] = 0.0,
    matrix: Annotated[
        bool,
        typer.Option(
            "--matrix",
            help="One perturbation at a time, at three strengths, with the dense filter and a sweep of 90°; needs "
            "--enrolled.",
        ),
    ] = False,
    leave_out: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="OBJECTS",
            help="Leave this number of objects out, five times, and search for them, too. "
            "Reports false accepts and rejects.",
        ),
    ] = None,
    bench_change: Annotated[
        str | None,
        typer.Option(
            metavar="mild|hard",
            help="Search by edges+colours after a change of a whole drawn bench; every ninth object is not enrolled. "
            "Uses --enrolled (36), --objects, --report, --reference none.",
        ),
    ] = None,
    objects: Annotated[
        str | None, typer.Option(metavar="FIRST-LAST", help="Evaluate only these objects, counted from 1; e.g. 51-100.")
    ] = None,
    report: Annotated[
        str | None,
        typer.Option(
            metavar="FIRST-LAST",
            help="Report only these objects; the searches use all objects. With --resume: also for earlier runs.",
        ),
    ] = None,
    margin: Annotated[
        float | None,
        typer.Option(min=0, help="Margin per view that ends a search of the paper (default: identify.margin)."),
    ] = None,
    jobs: JobsOption = None,
    cluster: ClusterOption = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Folder for the results (default: one in rig-eval for these settings)."),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue with the results in the folder.")] = False,
) -> None:
    """Measure retrieval on a folder of photographs in the layout of COIL-100, or on the catalog.

    Example: rig eval coil-100 --noise mb --methods all --trials 10
    """
    import hbr
    from hbr.evaluation.condition import Condition
    from hbr.evaluation.methods import choose_methods
    from hbr.evaluation.noise import Noise
    from hbr.evaluation.perturb import Perturbations
    from hbr.evaluation.protocol import Protocol
    from rig.evaluation.plan import Plan
    from rig.evaluation.report import contest_sentences, curve_rows, decision_rows
    from rig.evaluation.run import enrolled_views, run_plan
    from rig.evaluation.store import Store, own_folder
    from rig.evaluation.write import write_results

    workers = jobs_of(jobs, cluster) or os.cpu_count() or 1
    descriptor = descriptor_name(descriptor)
    try:
        if bench_change is not None:
            dataset = _dataset(settings, folder, objects)
            _bench_change(settings, dataset, bench_change, reference != "none", enrolled or 36, report, workers, out)
            return
        plan = Plan.of(
            _dataset(settings, folder, objects),
            Condition(
                size,
                Noise.parse(noise),
                rotate,
                background,  # type: ignore[arg-type]
                prefilter,
                Perturbations.parse(perturb),
                descriptor,
                reference,  # type: ignore[arg-type]
                Noise.parse(enrolled_noise),
            ),
            choose_methods((methods or ("all" if hbr.descriptor(descriptor).whole_image else "beyond")).split(",")),
            Protocol(
                trials,
                views,
                removal or ("queries" if enrolled else "near"),  # type: ignore[arg-type]
                10.0,
                orientation_noise,
                drift,
                settings.seed or 0,
                enrolled,
            ),
        )
        dataset = plan.dataset
        reported = None if report is None else _range(report)
        if reported is not None:
            dataset.subset(*reported)  # rejects objects that do not exist
        note = f"{dataset.name}: {len(dataset.objects)} objects, {dataset.views} views, {dataset.missing} missing"
        print(f"{note}, {dataset.ignored} other images" if dataset.ignored else note, file=sys.stderr)
        if leave_out is not None:
            _unknown_objects(settings, plan, leave_out, workers, out)
            return
        if matrix:
            _matrix(settings, plan, workers, out)
            return
        out = out or own_folder(f"{dataset.name}-{plan.condition.noise}", plan.settings())
        store = Store(out / "runs", plan.settings(), resume=resume)

        def tell(event: str) -> Callable[[str], None]:
            return lambda name: settings.print_json({"event": event, "object": name}) if settings.json else None

        with _progress("describing", len(dataset.objects), tell("described")) as advance:
            model = enrolled_views(plan, workers, advance)
        with _progress("searching", len(dataset.objects), tell("searched")) as advance:
            runs = run_plan(plan, model, store, workers, advance)
    except ValueError as error:
        raise UsageError(
            str(error), next_step="Correct the options or the data set, then continue with --resume."
        ) from error
    except KeyboardInterrupt:
        stored = f" The finished objects are stored in {out}. To continue, repeat the command with --resume."
        print(f"\nInterrupted.{'' if out is None else stored}", file=sys.stderr)
        raise typer.Exit(EXIT_INTERRUPTED) from None

    rule = settings.load().identify
    results = write_results(plan, runs, rule.margin if margin is None else margin, rule.min_views, out, reported)
    if settings.json:
        settings.print_json({"event": "finished", **results})
        return
    from rig.cli.ui.present import console

    screen = console()
    screen.print(curve_rows(results).terminal())
    screen.print()
    screen.print(decision_rows(results).terminal())
    screen.print()
    for sentence in contest_sentences(results):
        screen.print(sentence, markup=False, highlight=False, soft_wrap=not screen.is_terminal)
    print(f"Written: {out / 'report.html'}, results.json, results.csv and the figures beside it.", file=sys.stderr)


def _bench_change(
    settings: Settings,
    dataset: "Dataset",
    kind: str,
    picture: bool,
    enrolled: int,
    report: str | None,
    jobs: "Jobs",
    out: Path | None,
) -> None:
    from hbr.evaluation.changes import Changes
    from rig.evaluation.changes import change_rows, run_changes
    from rig.evaluation.store import own_folder

    if kind not in ("mild", "hard"):
        raise ValueError(f"bench change {kind!r} is unknown; use mild or hard")
    changes = Changes(kind, picture, enrolled, seed=settings.seed or 0)  # type: ignore[arg-type]
    reported = None if report is None else [item.name for item in dataset.subset(*_range(report)).objects]
    with _progress(_BOTH, 2 * len(dataset.objects)) as advance:
        results = run_changes(dataset, changes, jobs, advance, reported)
    names = [item.name for item in dataset.objects]
    out = out or own_folder(f"{dataset.name}-{kind}-change", asdict(changes) | {"objects": names, "reported": reported})
    _write(settings, results, change_rows(results), out / "bench_change.json", ".")


def _matrix(settings: Settings, plan: "Plan", jobs: "Jobs", out: Path | None) -> None:
    from rig.evaluation.matrix import matrix_rows, run_matrix
    from rig.evaluation.store import own_folder

    if plan.protocol.enrolled is None:
        raise ValueError("--matrix needs views that are not enrolled for its queries; give --enrolled 18 or fewer")
    with _progress(_BOTH, 2 * len(plan.dataset.objects)) as advance:
        results = run_matrix(plan, jobs, advance)
    out = out or own_folder(f"{plan.dataset.name}-matrix", plan.settings())
    _write(settings, results, matrix_rows(results), out / "matrix.json", ", with Wilson's intervals.")


def _unknown_objects(settings: Settings, plan: "Plan", left_out: int, jobs: "Jobs", out: Path | None) -> None:
    from rig.evaluation.run import enrolled_views
    from rig.evaluation.store import own_folder
    from rig.evaluation.unknown_objects import run_unknown_objects, unknown_object_rows

    with _progress(_BOTH, 2 * len(plan.dataset.objects)) as advance:
        results = run_unknown_objects(plan, enrolled_views(plan, jobs, advance), left_out, _DRAWS, jobs, advance)
    out = out or own_folder(f"{plan.dataset.name}-leave-out-{left_out}", plan.settings())
    _write(settings, results, unknown_object_rows(results), out / "unknown_objects.json", ", with Wilson's intervals.")


@contextmanager
def _progress(title: str, total: int, tell: Callable[[str], None] = lambda _: None) -> Iterator[Callable[[str], None]]:
    """Show a progress bar, and yield what is to be called with the name of each object that is done."""
    from rig.catalog.jobs import JobProgress
    from rig.cli.ui.present import Progress

    done = count(1)
    with Progress(title) as progress:

        def advance(name: str) -> None:
            progress(JobProgress(next(done), total))
            tell(name)

        yield advance


def _write(settings: Settings, results: dict[str, Any], rows: "Rows", path: Path, note: str) -> None:
    from rig.cli.ui.present import console
    from rig.evaluation.write import write_json

    write_json(results, path)
    if settings.json:
        settings.print_json({"event": "finished", **results})
        return
    console().print(rows.terminal())
    print(f"Written: {path}{note}", file=sys.stderr)


def _dataset(settings: Settings, folder: Path | None, objects: str | None) -> "Dataset":
    from hbr.evaluation.datasets import load_coil
    from rig.evaluation.plan import load_catalog

    if folder is None:
        with settings.open_catalog(read_only=True) as catalog:
            dataset = load_catalog(catalog, settings.load().view.roi)
    else:
        dataset = load_coil(folder)
    if objects is None:
        return dataset
    return dataset.subset(*_range(objects))


def _range(text: str) -> tuple[int, int]:
    first, _, last = text.partition("-")
    if not (first.isdecimal() and last.isdecimal()):
        raise ValueError(f"objects {text!r} is not a range; give the first and the last, e.g. 51-100")
    return int(first), int(last)
