"""Catalogs in open formats: what leaves one, and what comes into one."""

from rig.catalog.exchange.bundle import open_bundle, write_bundle
from rig.catalog.exchange.collect import collect, package_of
from rig.catalog.exchange.folder import DEFAULT_PATTERN, read_folder, write_folder
from rig.catalog.exchange.intake import Imported, bring_in, preview_import
from rig.catalog.exchange.package import Gap, Package, Refused
from rig.catalog.exchange.plan import Conflict, Plan, plan_import
from rig.catalog.exchange.table import read_table, write_parquet, write_table

__all__ = [
    "DEFAULT_PATTERN",
    "Conflict",
    "Gap",
    "Imported",
    "Package",
    "Plan",
    "Refused",
    "bring_in",
    "collect",
    "open_bundle",
    "package_of",
    "plan_import",
    "preview_import",
    "read_folder",
    "read_table",
    "write_bundle",
    "write_folder",
    "write_parquet",
    "write_table",
]
