"""The base of all sections of `rig.toml`."""

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ConfigDict, model_validator

from rig.config.toml_file import NONE
from rig.config.wording import is_optional


class Section(BaseModel):
    """Base of all sections: unknown keys are errors, and values cannot change.

    TOML has no null: the text ``"none"`` clears an optional key.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _read_none(cls, values: Any) -> Any:
        if not isinstance(values, Mapping):
            return values
        cleared = {key for key in values if values[key] == NONE and key in cls.model_fields}
        return {k: None if k in cleared and is_optional(cls.model_fields[k]) else v for k, v in values.items()}
