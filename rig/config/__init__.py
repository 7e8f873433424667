"""The configuration of a bench: its schema, its TOML file, and the values in force."""

from rig.config.device_sections import CameraConfig, CameraTimeConfig, HeadConfig, ImuConfig, ServoConfig
from rig.config.schema import CatalogConfig, EnrollConfig, IdentifyConfig, RigConfig, ViewConfig, load_config
from rig.config.section import Section
from rig.config.table_sections import MAX_LIMIT_DEG, MarkConfig, SafetyConfig, TableConfig

__all__ = [
    "MAX_LIMIT_DEG",
    "CameraConfig",
    "CameraTimeConfig",
    "CatalogConfig",
    "EnrollConfig",
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
