"""Hit rates of an experiment with several descriptors, on the same trials, compared with those of the first one."""

import argparse
from pathlib import Path

import numpy as np

from hbr.evaluation.photographs import load_coil
from hbr.evaluation.protocol import generator
from hbr.evaluation.statistics import bootstrap_difference, mcnemar_exact, wilson
from hbr.evaluation.trials import TRIALS
from rig.evaluation.experiments import load_experiment


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("experiment")
    parser.add_argument("descriptors", nargs="+", help="Names; several with weights: cedd=0.5,network=0.5.")
    parser.add_argument("--data", type=Path, required=True, help="Images obj{N}__{angle}.png.")
    parser.add_argument("--noise")
    parser.add_argument("--methods", default="hbr,ahbr")
    parser.add_argument("--views", type=int, nargs="+", default=[1, 4, 8])
    given = parser.parse_args()
    first = None
    for name in given.descriptors:
        asked = load_experiment(given.experiment, descriptor=name, noise=given.noise, methods=given.methods)
        photographs = load_coil(given.data)
        dataset = (photographs if asked.objects is None else photographs.subset(*asked.objects)).every(asked.every)
        objects = range(len(dataset.objects))
        model = TRIALS.model(asked, dataset, [TRIALS.enroll(asked, dataset, j) for j in objects])
        found = [TRIALS.search(asked, dataset, model, lambda: 0, j) for j in objects]
        hits = np.concatenate([runs.rank for runs in found], axis=1) == 1
        first = hits if first is None else first
        for m, method in enumerate(asked.methods):
            for n in given.views:
                own, other = hits[m, :, :, n - 1], first[m, :, :, n - 1]
                low, high = wilson(int(own.sum()), own.size)
                rng = generator(asked.protocol.seed, dataset.name, "bootstrap", 0)
                less, more = bootstrap_difference(own, other, rng)
                p = mcnemar_exact(int((own & ~other).sum()), int((other & ~own).sum()))
                print(
                    f"{name:<32} {method.name:<10} N = {n}: {100 * own.mean():5.1f} "
                    f"[{100 * low:.1f}, {100 * high:.1f}] %, difference {100 * (own.mean() - other.mean()):+.1f} "
                    f"[{100 * less:+.1f}, {100 * more:+.1f}], p = {p:.2g}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
