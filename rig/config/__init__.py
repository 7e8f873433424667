"""The configuration of a bench: its schema, its TOML file, and the values in force."""

from rig.config.schema import (
    MAX_LIMIT_DEG,
    CameraConfig,
    CameraTimeConfig,
    HeadConfig,
    IdentifyConfig,
    ImuConfig,
    MarkConfig,
    RigConfig,
    SafetyConfig,
    Section,
    ServoConfig,
    TableConfig,
    ViewConfig,
    load_config,
)

__all__ = [
    "MAX_LIMIT_DEG",
    "CameraConfig",
    "CameraTimeConfig",
    "HeadConfig",
    "IdentifyConfig",
    "ImuConfig",
    "MarkConfig",
    "RigConfig",
    "SafetyConfig",
    "Section",
    "ServoConfig",
    "TableConfig",
    "ViewConfig",
    "load_config",
]
