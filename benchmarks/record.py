"""The results of benchmarks in one file, ``bench.json``: ratios to a named peer, which hold on other computers, too."""

import json
import timeit
from collections.abc import Callable
from pathlib import Path
from typing import Final

PATH: Final = Path("bench.json")


def times_ms(
    work: Callable[[], object], repeats: int, timer: Callable[[], float] = timeit.default_timer, *, first: bool = True
) -> list[float]:
    """Return the time of each call in milliseconds; ``first``: after a call that fills the caches."""
    if first:
        work()
    return [1e3 * seconds for seconds in timeit.repeat(work, number=1, repeat=repeats, timer=timer)]


def record(name: str, took_ms: float, peer: str, peer_ms: float) -> None:
    """Print a result, and store it."""
    ratio = took_ms / peer_ms
    print(f"{name:<64} {took_ms:10.3f} ms {ratio:8.2f} x {peer}", flush=True)
    results = json.loads(PATH.read_text(encoding="utf-8")) if PATH.exists() else {}
    results[name] = {"ms": round(took_ms, 4), "ratio": round(ratio, 3), "peer": peer}
    PATH.write_text(json.dumps(results, indent=1, sort_keys=True) + "\n", encoding="utf-8")
