"""The methods that are compared: each chooses views and ranks objects in its own way."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, Literal

from hbr.paper.hough import Extension

Strategy = Literal[
    "random",
    "sweep-45",
    "sweep-90",
    "ahbr",
    "ahbr-90",
    "coin",
    "next-best-view",
    "next-best-view-coin",
    "mutual",
    "oracle",
]


@dataclass(frozen=True)
class Method:
    """A retrieval method.

    Attributes
    ----------
    name : str
        Name in ``--methods``.
    label : str
        Name in tables and figures.
    strategy : str
        How the next view is chosen. ``random``; ``sweep-45``, ``sweep-90``: fixed steps; ``ahbr``: Eq. 5-7; ``coin``:
        the step of Eq. 5-7 to a random side. ``ahbr`` and ``coin`` begin with two random views, ``ahbr-90`` with a
        step of 90° to the left, like the rig. With the dense filter only: ``next-best-view``: `hbr.next_best_view`;
        ``next-best-view-coin``: its rotation to a random side; ``mutual``: mutual information; ``oracle``: the
        photograph with the largest lead of the true object.
    omega, list_length, extension
        Parameters of `hbr.retrieve` or `hbr.DenseIndex`.
    views : int or None
        Largest number of views of this method; None: that of the protocol.
    dense : bool
        Whether the dense filter ranks the objects, instead of the paper's voting.
    """

    name: str
    label: str
    strategy: Strategy = "random"
    omega: float = 0.5
    list_length: int = 10
    extension: Extension = "orient_all"
    views: int | None = None
    dense: bool = False

    @property
    def active(self) -> bool:
        return self.strategy in ("ahbr", "ahbr-90", "coin")


_LISTED: Final = (
    Method("single", "single view", omega=0.0, extension="visual", views=1),
    Method("hbr-visual", "HBR best visual match", omega=0.0, extension="visual"),
    Method("hbr-0", "HBR ω = 0", omega=0.0),
    Method("hbr-0-orient", "HBR ω = 0 (orient)", omega=0.0, extension="orient"),
    Method("hbr", "HBR ω = 0.5"),
    Method("hbr-orient", "HBR ω = 0.5 (orient)", extension="orient"),
    Method("ahbr", "AHBR ω = 0.5", strategy="ahbr"),
    Method("ahbr-orient", "AHBR ω = 0.5 (orient)", strategy="ahbr", extension="orient"),
    Method("ahbr-90", "AHBR, first rotation 90°", strategy="ahbr-90"),
    Method("coin", "coin flip", strategy="coin"),
    Method("sweep-45", "sweep 45°", strategy="sweep-45"),
    Method("sweep-90", "sweep 90°", strategy="sweep-90"),
)
_OMEGA: Final = 2.0
_DENSE: Final = (
    Method("dense", "dense filter, next best view", "next-best-view", _OMEGA, dense=True),
    Method("dense-coin", "dense filter, coin flip", "next-best-view-coin", _OMEGA, dense=True),
    Method("dense-random", "dense filter, random", "random", _OMEGA, dense=True),
    Method("dense-45", "dense filter, sweep 45°", "sweep-45", _OMEGA, dense=True),
    Method("dense-90", "dense filter, sweep 90°", "sweep-90", _OMEGA, dense=True),
    Method("dense-mutual", "dense filter, mutual information", "mutual", _OMEGA, dense=True),
    Method("dense-oracle", "dense filter, oracle", "oracle", _OMEGA, dense=True),
)
_OMEGAS: Final = (0.0, 0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
_LENGTHS: Final = (1, 2, 5, 10, 20, 50, 100)
_OMEGA_SWEEP: Final = tuple(Method(f"omega-{omega:g}", f"HBR ω = {omega:g}", omega=omega) for omega in _OMEGAS)
_LIST_SWEEP: Final = tuple(Method(f"list-{n}", f"HBR lists of {n}", list_length=n) for n in _LENGTHS)

METHODS: Final = {method.name: method for method in (*_LISTED, *_DENSE, *_OMEGA_SWEEP, *_LIST_SWEEP)}
GROUPS: Final[dict[str, tuple[Method, ...]]] = {
    "all": _LISTED,
    "beyond": _DENSE[:-1],  # the oracle tries every view, which is slow
    "omega-sweep": _OMEGA_SWEEP,
    "list-sweep": _LIST_SWEEP,
}


def choose_methods(names: Iterable[str]) -> tuple[Method, ...]:
    """Return the methods of these names and groups, each once.

    Raises
    ------
    ValueError
        There is no name, or one is neither a method nor a group.
    """
    chosen: dict[str, Method] = {}
    for name in names:
        if name in GROUPS:
            chosen |= {method.name: method for method in GROUPS[name]}
        elif name in METHODS:
            chosen[name] = METHODS[name]
        else:
            listed = ", ".join([*GROUPS, *(method.name for method in (*_LISTED, *_DENSE))])
            raise ValueError(f"method {name!r} is unknown; use some of {listed}")
    if not chosen:
        raise ValueError("no method is given; use all for the whole comparison")
    return tuple(chosen.values())
