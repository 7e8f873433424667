"""Descriptors and models that the operator names; a catalog or a saved run names a model by its digest only."""

from pathlib import Path
from typing import Annotated

import typer

from rig.core.errors import UsageError

ModelOption = Annotated[
    Path | None,
    typer.Option(
        "--model",
        metavar="FILE",
        help="ONNX file of the run's descriptor, if it is a network. It must match the digest in the run.",
    ),
]


def descriptor_name(given: str) -> str:
    """Return the name of the descriptor that the operator named; ``onnx:FILE`` loads the file.

    Raises
    ------
    UsageError
        There is no such descriptor, or the file is no model.
    """
    from hbr.descriptors import load_descriptor, names

    try:
        return load_descriptor(given).name
    except ValueError as error:
        raise UsageError(
            f"The descriptor {given} cannot be used.",
            next_step=f"Choose one of {', '.join(names())}, or onnx:FILE.",
            evidence={"reason": str(error)},
        ) from error


def load_model_file(path: Path | None) -> None:
    """Load the model that the operator gives for a saved run, if any.

    Raises
    ------
    UsageError
        The file is no model.
    """
    if path is not None:
        descriptor_name(f"onnx:{path}")
