"""Experiments as text: the shipped ones (`experiments.toml`), and TOML files."""

import tomllib
from dataclasses import fields
from importlib.resources import files
from operator import attrgetter
from pathlib import Path
from typing import Any, Final

from pydantic import TypeAdapter, ValidationError

from hbr.descriptors import descriptor
from hbr.drawing.noise import Noise
from hbr.evaluation.condition import Condition
from hbr.evaluation.experiment import Experiment
from hbr.evaluation.perturb import Perturbations
from hbr.evaluation.photographs import Dataset, Photograph, PhotographedObject
from hbr.evaluation.protocol import Protocol, choose_methods
from rig.catalog import Catalog
from rig.core import files as own_files

DEFAULT: Final = "paper"
_MAX_BYTES: Final = 1_000_000  # far above an experiment and its orientation errors; a larger file is another one


def shipped() -> dict[str, dict[str, Any]]:
    """Return the keys of each shipped experiment, by name."""
    return tomllib.loads(files("rig.evaluation").joinpath("experiments.toml").read_text(encoding="utf-8"))


def load_experiment(name: str, **changed: Any) -> Experiment:
    """Return a shipped experiment, or that of a TOML file, with some keys changed; None changes nothing.

    A key is an attribute of `Experiment`, `Condition` or `Protocol`. The key ``base`` names a shipped experiment whose
    keys hold, too. The key ``orientation_errors`` names a file for `rotation_errors`.

    Raises `ValueError`: there is no such experiment, or a key or value is wrong.
    """
    known = shipped()
    if name in known:
        keys = dict(known[name])
    elif name.endswith(".toml"):
        try:
            keys = tomllib.loads(own_files.read(Path(name), max_bytes=_MAX_BYTES).decode())
        except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
            raise ValueError(f"the experiment {name} cannot be read: {error}") from error
    else:
        raise ValueError(f"experiment {name!r} is unknown; use a TOML file, or one of {', '.join(known)}")
    while (base := keys.pop("base", None)) is not None:
        if base not in known:
            raise ValueError(f"base {base!r} is unknown; use one of {', '.join(known)}")
        keys = known[base] | keys
    return _filled(Path(name).stem, keys | {key: value for key, value in changed.items() if value is not None})


def _filled(name: str, keys: dict[str, Any]) -> Experiment:
    """Return the experiment with these keys; texts become noise, perturbations, methods and ranges."""
    reading = {"noise": Noise.parse, "enrolled_noise": Noise.parse, "perturbations": Perturbations.parse}
    keys = {key: reading[key](str(value)) if key in reading else value for key, value in keys.items()}
    keys |= {key: _range(str(keys[key])) for key in ("objects", "report") if keys.get(key) is not None}
    # queries are not enrolled if only some views are
    keys.setdefault("removal", "queries" if keys.get("enrolled") else "near")
    of = descriptor(keys.get("descriptor", "cedd"))
    chosen = keys.pop("methods", None) or ("all" if of.whole_image else "beyond")
    own: dict[str, Any] = {"name": name, "methods": choose_methods(str(chosen).split(","))}
    if (errors := keys.pop("orientation_errors", None)) is not None:
        keys["rotation_errors_deg"] = rotation_errors(str(errors))
    for attribute, kind in (("condition", Condition), ("protocol", Protocol)):
        mine = [item.name for item in fields(kind)]
        own[attribute] = _checked(kind, {key: keys.pop(key) for key in mine if key in keys})
    experiment: Experiment = _checked(Experiment, own | keys)
    return experiment


def rotation_errors(name: str) -> tuple[float, ...]:
    """Return measured errors of rotations in degrees.

    They come from a stored result of ``rig calibrate imu`` (the gyro's rotation minus the encoder's, of each move), or
    from a JSON file with ``rotation_errors_deg``; "mpu6050" names the shipped one.

    Raises `ValueError`: the file cannot be read, or it has no such errors.
    """
    path = Path(str(files("rig.evaluation").joinpath("mpu6050.json"))) if name == "mpu6050" else Path(name)
    try:
        values = own_files.json_values(own_files.read(path, max_bytes=_MAX_BYTES))
        if "rotation_errors_deg" in values:
            found = [float(value) for value in values["rotation_errors_deg"]]
        else:
            legs = [move["leg"] for move in values["evidence"]["moves"]]
            # a gyro that is mounted upside down counts the other way
            found = [abs(leg["gyro_deg"]) - abs(leg["encoder_deg"]) for leg in legs if not leg["invalid"]]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"the orientation errors {name} cannot be read: {error!r}; name the file imu.rotation of "
            "rig calibrate imu, or a JSON file with rotation_errors_deg"
        ) from error
    if not found:
        raise ValueError(f"{name} has no errors of rotations; run rig calibrate imu again")
    return tuple(found)


def _checked(kind: type[Any], values: dict[str, Any]) -> Any:
    unknown = sorted(values.keys() - {item.name for item in fields(kind)})
    if unknown:
        raise ValueError(f"an experiment has no key {', '.join(unknown)}; see rig/evaluation/experiments.toml")
    try:
        return TypeAdapter(kind).validate_python(values)
    except ValidationError as error:
        first = error.errors()[0]
        reason = first.get("ctx", {}).get("error")
        place = ".".join(map(str, first["loc"]))
        raise ValueError(str(reason) if reason else f"{place}: {first['msg']}") from error


def _range(text: str) -> tuple[int, int]:
    first, _, last = text.partition("-")
    if not (first.isdecimal() and last.isdecimal()):
        raise ValueError(f"objects {text!r} is not a range; give the first and the last, e.g. 51-100")
    return int(first), int(last)


def load_catalog(catalog: Catalog) -> Dataset:
    """Return the stored images of a catalog as a data set, each with the part that searches use.

    Raises `DatasetError`: there are fewer than two objects, or two views of an object from the same angle.
    """
    objects = []
    for summary in catalog.objects():
        enrollment = catalog.object(summary.name).complete
        if enrollment is not None and enrollment.views:
            photographs = [
                Photograph(catalog.image_path(view.image), view.azimuth_deg, view.region) for view in enrollment.views
            ]
            ordered = tuple(sorted(photographs, key=attrgetter("azimuth_deg")))
            objects.append(PhotographedObject(summary.name, ordered))
    return Dataset(str(catalog.place), tuple(objects))
