"""The evidence of a segmentation: its method and its issues, as codes with numbers."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any


class Method(StrEnum):
    """The methods of finding the object's box."""

    EMPTY_TABLE = "empty-table"
    """The object differs from the empty-table image."""
    PLAIN_BACKGROUND = "plain-background"
    """The object differs from a plain background."""
    NETWORK = "network"
    """A small neural network found the object, without any background."""
    ROTATION = "rotation"
    """The same network, with the background that the other views of the search or enrollment show."""
    GUESS = "guess"
    """The object has other colours than the frame's border. Often wrong."""
    GIVEN_BOX = "given-box"
    """The caller gave the box."""
    NONE = "none"
    """No object was found."""


class IssueCode(StrEnum):
    """The issues of a segmentation. The parameters of an issue are listed with its code."""

    TABLE_SIZE = "empty-table-size"
    """The empty-table image has another size: ``table_px`` and ``frame_px``, [width, height]."""
    TABLE_DIFFERS = "empty-table-differs"
    """The frame's border does not look like the empty-table image: ``agreement``, 0..1."""
    BACKDROP_EXPOSURE = "backdrop-exposure"
    """Most of the backdrop is too dark or overexposed: its colour is not measurable."""
    BACKDROP_COLOURS = "backdrop-several-colours"
    """The backdrop has several colours: none of them is known to be grey."""
    BACKDROP_COLOURFUL = "backdrop-colourful"
    """The backdrop's colour is too far from grey."""
    BACKDROP_LEVEL = "backdrop-level"
    """The backdrop is too dark or too bright to correct the exposure with it."""
    BACKGROUND_NOT_PLAIN = "background-not-plain"
    """The background is not plain: the object can only be guessed from its colours, or found by rotation."""
    NO_OBJECT = "no-object"
    """The network found no object."""
    NO_GUESS = "no-guess"
    """No part of the frame stands out by its colours."""
    NO_DIFFERENCE = "no-difference"
    """Nothing differs from the plain background."""
    PATCH_UNEVEN = "grey-patch-uneven"
    """The grey patch has several grey levels."""
    PATCH_EXPOSURE = "grey-patch-exposure"
    """The grey patch is overexposed or too dark."""


@dataclass(frozen=True, slots=True)
class Issue:
    """An issue: its code, such as an `IssueCode`, and the JSON values that are listed with the code."""

    code: StrEnum
    parameters: Mapping[str, Any] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """Return the code and the parameters in one flat mapping."""
        return {"code": self.code.value, **self.parameters}
